//! A policy as an ONNX model, for the command `export`.

use std::path::Path;

use super::exit::Failure;
use super::failures;
use crate::policy::Policy;
use crate::policy::onnx::to_onnx;

/// Returns the contents of an ONNX file with the network of the policy in `file`.
///
/// # Errors
/// The file cannot be read, is no policy, or is a policy without a network.
pub fn onnx_model(file: &Path) -> Result<Vec<u8>, Failure> {
    match Policy::load(file).map_err(|error| failures::policy(&error))? {
        Policy::Network(policy) => Ok(to_onnx(&policy)),
        _ => Err(Failure::usage(format!(
            "{}: it contains no network, so it cannot be exported as ONNX. Give a policy that `train` or `import` wrote",
            file.display()
        ))),
    }
}
