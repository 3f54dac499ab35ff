use clap::ValueEnum;

use crate::safety::Guard;

/// `--guard`, as the command line spells it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum GuardArgument {
    /// The safety box of the thesis and nothing more: to compare with published figures
    Box,
    /// The speed envelope too: the arm is braked before its hard stop cannot be avoided any more
    Envelope,
}

impl From<GuardArgument> for Guard {
    fn from(argument: GuardArgument) -> Self {
        match argument {
            GuardArgument::Box => Self::Box,
            GuardArgument::Envelope => Self::Envelope,
        }
    }
}
