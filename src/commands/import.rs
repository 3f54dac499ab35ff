use std::path::PathBuf;

use serde_json::json;

use super::destination::OutputFile;
use super::estimator_arguments::corner;
use super::exit::Failure;
use super::number_arguments::between;
use super::output::Output;
use super::plant_file::PlantArgument;
use super::printable::one_line;
use crate::estimation::EstimatorSettings;
use crate::policy::Policy;
use crate::policy::onnx::{
    ForeignConventions, ImportError, MAX_FILE_BYTES, ObservationLayout, from_onnx,
};
use crate::qube::{MAX_HISTORY, PlantModel};
use crate::storage::{Existing, read_bounded};

/// Import a policy from an ONNX file of another program, or from a file that `export --onnx` wrote
///
/// The network is a multilayer perceptron with one output: Gemm or MatMul and Add, Tanh, Relu, Elu
/// or Silu, and at the end Tanh or nothing. A normalisation and a Clip before the first layer, and
/// a factor and a Clip after the last, become a part of the policy. Any other operator is refused,
/// by its name. A file that `export --onnx` wrote names its conventions and needs no option.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil import model.onnx --action-scale 5 --out mine.safetensors\n  \
    qube-hil import model.onnx --action-scale 5 --history 2 --filter 200\n  \
    qube-hil import model.onnx --action-scale 18 \\\n      \
    --observation=cos_theta,sin_theta,-1*cos_alpha,-1*sin_alpha,theta_dot,alpha_dot\n  \
    qube-hil import exported.onnx --out again.safetensors")]
pub struct Arguments {
    /// ONNX file; its first output is the action
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Voltage for an output of 1, V; a negative value reverses the sign. Required, except for a
    /// file that `export --onnx` wrote
    #[arg(long, value_name = "V", value_parser = scale)]
    action_scale: Option<f64>,

    #[command(flatten)]
    plant: PlantArgument,

    /// Entries of the observation in the network's order, each with or without a factor
    /// (0.1*theta_dot): sin_theta, cos_theta, sin_alpha, cos_alpha, theta_dot, alpha_dot (rad/s),
    /// command_1 to command_4 (the newest first, as fractions of 5 V). alpha is 0 where the
    /// pendulum hangs [default: this program's own observation]
    #[arg(long, value_name = "NAMES", value_parser = ObservationLayout::parse, conflicts_with = "history")]
    observation: Option<ObservationLayout>,

    /// Number of last commands in this program's own observation, 0 to 4 [default: 0]
    #[arg(
        long,
        value_name = "COMMANDS",
        value_parser = clap::value_parser!(u8).range(..=MAX_HISTORY as i64)
    )]
    history: Option<u8>,

    /// Corner of the velocity filter with which the policy was trained, rad/s; it goes into the
    /// policy's record [default: 200]
    #[arg(long, value_name = "RAD/S", value_parser = corner)]
    filter: Option<f64>,

    /// Clip each entry of the observation, as the network sees it, between -LIMIT and LIMIT, as a
    /// training did outside of the exported network; a Clip in the file is kept without this
    #[arg(long, value_name = "LIMIT", value_parser = limit)]
    clip_observation: Option<f64>,

    /// File for the policy
    #[arg(long, value_name = "FILE", default_value = "policy.safetensors")]
    out: PathBuf,

    /// Replace the file of --out, if it exists
    #[arg(long)]
    force: bool,
}

/// Advice if the ONNX file does not exist: usually the exporter has failed and written none.
const EXPORT_FAILED: &str = ". If torch.onnx.export failed, as its default exporter does for the policies of \
    Stable-Baselines3, use Policy.from_sb3 or Policy.from_torch of the Python package, or export with dynamo=False";

impl Arguments {
    /// Returns whether an option besides `--action-scale` gives a convention of a foreign file.
    fn gives_conventions(&self) -> bool {
        self.observation.is_some()
            || self.history.is_some()
            || self.filter.is_some()
            || self.clip_observation.is_some()
            || self.plant.is_given()
    }

    /// Returns the conventions of a foreign file, from the options; `None` without
    /// `--action-scale`, for a file that names its own.
    fn foreign(&self, plant: PlantModel) -> Option<ForeignConventions> {
        let own = || ObservationLayout::own(self.history.unwrap_or_default().into());
        self.action_scale.map(|action_scale_v| ForeignConventions {
            layout: self.observation.clone().unwrap_or_else(own),
            action_scale_v: action_scale_v as f32,
            corner_rad_s: self.filter.unwrap_or(EstimatorSettings::default().corner_rad_s),
            clip_observation: self.clip_observation.map(|limit| limit as f32),
            plant,
        })
    }
}

/// Reads the model and writes the policy.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let path = arguments.file.display();
    // The file is foreign, and so are the names of operators and constants in it.
    let refused =
        |message: &dyn std::fmt::Display| Failure::usage(one_line(&format!("{path}: {message}")));
    let out = OutputFile::prepare(&arguments.out, Existing::replaced_if(arguments.force))?;
    let bytes = read_bounded(&arguments.file, MAX_FILE_BYTES).map_err(|error| {
        let remedy = if error.kind() == std::io::ErrorKind::NotFound { EXPORT_FAILED } else { "" };
        refused(&format!("cannot be read: {error}{remedy}"))
    })?;
    let foreign = arguments.foreign(arguments.plant.plant()?);
    let policy = from_onnx(&bytes, foreign.as_ref()).map_err(|error| match error {
        ImportError::NoActionScale => refused(&format!("{error} (--action-scale)")),
        other => refused(&other),
    })?;
    // Without a scale the file was read as one that this program wrote.
    if arguments.action_scale.is_none() && arguments.gives_conventions() {
        return Err(refused(&ImportError::OwnConventions));
    }
    let (sizes, activation) = (policy.network.sizes().to_vec(), policy.network.activation());
    let policy = Policy::Network(policy);
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

/// Parses a scale from -100 to 100 V whose magnitude is at least 1e-6 V.
fn scale(text: &str) -> Result<f64, String> {
    let scale_v = between(text, -100.0, 100.0)?;
    // A policy's file has the scale in single precision, where much smaller ones are 0.
    if scale_v.abs() < 1e-6 {
        return Err("give a voltage whose magnitude is at least 1e-6 V".into());
    }
    Ok(scale_v)
}

/// Parses a limit of the observation's entries from 0.001 to 1e6.
fn limit(text: &str) -> Result<f64, String> {
    between(text, 0.001, 1e6)
}
