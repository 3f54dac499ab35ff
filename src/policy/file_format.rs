//! The fixed names and numbers of the file format of a policy, which its reader, its writer and its
//! error messages share.

use crate::qube::{MAX_HISTORY, OBSERVATION_SIZE};

/// Newest version of the format; files of later versions are refused. A policy that version 1 can
/// express is written in version 1, so that a later version of the format does not change its
/// bytes. Version 1 has no other functions than tanh and a linear output, no bounds and no
/// randomisation.
pub const FORMAT_VERSION: u32 = 2;

/// Largest file that is read, bytes: ten times the largest network within the limits.
pub const MAX_FILE_BYTES: u64 = 8 << 20;

/// Name of the only entry of the metadata of a safetensors file.
pub(super) const METADATA_KEY: &str = "policy";

/// The activation of every network in version 1.
pub(super) const VERSION_1_ACTIVATION: &str = "tanh";

/// Names of the entries that an observation may have, in order: the state (see
/// [`crate::qube::observation`]), then as many of the last commands, as fractions of 5 V, as the
/// network was trained with.
pub(super) const OBSERVATION_LAYOUT: [&str; OBSERVATION_SIZE + MAX_HISTORY] = [
    "sin(theta)",
    "cos(theta)",
    "sin(alpha)",
    "cos(alpha)",
    "0.1 theta_dot",
    "0.05 alpha_dot",
    "last command / 5 V",
    "last command but one / 5 V",
    "last command but two / 5 V",
    "last command but three / 5 V",
];
