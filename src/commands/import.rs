use std::path::PathBuf;

use serde_json::json;

use super::destination::OutputFile;
use super::exit::Failure;
use super::number_arguments::between;
use super::output::Output;
use crate::estimation::EstimatorSettings;
use crate::policy::onnx::{Layers, MAX_FILE_BYTES, Sight};
use crate::policy::{NetworkPolicy, Policy, TrainingRecord};
use crate::qube::MAX_HISTORY;
use crate::storage::read_bounded;

/// Import a policy that another program trained, from an ONNX file
///
/// The network is a multilayer perceptron with one output: Gemm or MatMul and Add, Tanh, Relu, Elu or Silu, and Tanh
/// at the end or nothing. Constants before the first layer (a normalisation) become a part of it. Everything else is
/// refused by name.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil import model.onnx --action-scale 5 --out mine.safetensors\n  \
    qube-hil import model.onnx --action-scale 5 --history 2 --filter 200\n  \
    qube-hil import model.onnx --action-scale 18 \\\n      \
    --observation=cos_theta,sin_theta,-1*cos_alpha,-1*sin_alpha,theta_dot,alpha_dot")]
pub struct Arguments {
    /// ONNX file; its first output is the action
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Voltage for an output of 1, V; a negative one turns the sign. The program never guesses it
    #[arg(long, value_name = "V", value_parser = scale)]
    action_scale: f64,

    /// Entries of the observation in the network's order, each with or without a factor (0.1*theta_dot): sin_theta,
    /// cos_theta, sin_alpha, cos_alpha, theta_dot, alpha_dot (rad/s), command_1 to command_4 (the newest first, as
    /// fractions of 5 V). alpha is 0 where the pendulum hangs [default: this program's own observation]
    #[arg(long, value_name = "NAMES", value_parser = Sight::parse, conflicts_with = "history")]
    observation: Option<Sight>,

    /// Number of last commands in this program's own observation, 0 to 4 [default: 0]
    #[arg(long, value_name = "COMMANDS", value_parser = clap::value_parser!(u8).range(..=MAX_HISTORY as i64))]
    history: Option<u8>,

    /// Corner of the velocity filter with which the policy was trained, rad/s; it goes into the policy's record
    #[arg(long, value_name = "RAD/S", default_value = "200", value_parser = corner)]
    filter: f64,

    /// File for the policy
    #[arg(long, value_name = "FILE", default_value = "policy.safetensors")]
    out: PathBuf,

    /// Replace --out where there is such a file already
    #[arg(long)]
    force: bool,
}

/// Reads the model and writes the policy.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let path = arguments.file.display();
    let refused = |what: &dyn std::fmt::Display| Failure::usage(format!("{path}: {what}"));
    let out = OutputFile::prepare(&arguments.out, arguments.force)?;
    let bytes = read_bounded(&arguments.file, MAX_FILE_BYTES)
        .map_err(|error| refused(&format!("cannot be read: {error}")))?;
    let sight = arguments
        .observation
        .clone()
        .unwrap_or_else(|| Sight::own(arguments.history.unwrap_or_default().into()));
    let layers = Layers::from_onnx(&bytes).map_err(|error| refused(&error))?;
    let network =
        layers.network(&sight, arguments.action_scale as f32).map_err(|error| refused(&error))?;
    let (sizes, activation) = (network.sizes().to_vec(), network.activation());
    let training =
        TrainingRecord::imported(EstimatorSettings::filter(arguments.filter).corner_rad_s);
    let policy = Policy::Network(NetworkPolicy { network, training });
    out.write(&policy.to_bytes())?;
    let written = arguments.out.display();
    let text = format!("{written}: a network of sizes {sizes:?} with {}", activation.name());
    let result = json!({
        "policy": arguments.out.to_string_lossy(),
        "sizes": sizes,
        "activation": activation.name(),
    });
    output.print(&text, &result);
    Ok(())
}

/// Parses a scale from -100 to 100 that is not 0.
fn scale(text: &str) -> Result<f64, String> {
    let scale_v = between(text, -100.0, 100.0)?;
    if scale_v == 0.0 { Err("give a voltage other than 0".into()) } else { Ok(scale_v) }
}

/// Parses a filter's corner.
fn corner(text: &str) -> Result<f64, String> {
    between(text, 1.0, 10_000.0)
}
