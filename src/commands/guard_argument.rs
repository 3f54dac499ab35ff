use clap::ValueEnum;
use clap::builder::TypedValueParser;

use super::exit::Failure;
use super::retired_names::names_and_retired;
use crate::safety::{Guard, GuardConsent};

/// The guard in the spelling of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum GuardArgument {
    /// The thesis's safety box only, to compare with published figures
    Box,
    /// Foresight in addition: before each voltage is sent, the brake is simulated for many Qubes
    /// that this one may be, and the arm is braked before a brake would come too late
    Foresight,
}

/// Returns the parser of `--guard`.
pub fn guard_parser() -> impl TypedValueParser<Value = GuardArgument> {
    names_and_retired("envelope", "it is only for replays of old recordings; use foresight")
}

impl From<GuardArgument> for Guard {
    fn from(argument: GuardArgument) -> Self {
        match argument {
            GuardArgument::Box => Self::Box,
            GuardArgument::Foresight => Self::Foresight,
        }
    }
}

/// The second of the two arguments that switch the guard off on a real Qube.
#[derive(Clone, Copy, Debug, clap::Args)]
#[command(next_help_heading = "Qube")]
pub struct ConsentArgument {
    /// With --guard box on a real Qube: accept that the arm may reach its hard stop; the recordings
    /// note it
    #[arg(long)]
    accept_hard_stop: bool,
}

impl ConsentArgument {
    /// Returns the operator's consent, if both arguments are on this command line. Consent without
    /// `--guard box` is refused.
    pub fn with_guard(self, guard: Option<GuardArgument>) -> Result<Option<GuardConsent>, Failure> {
        if self.accept_hard_stop && guard != Some(GuardArgument::Box) {
            return Err(Failure::usage(
                "--accept-hard-stop accepts that the arm may reach its hard stop, which only --guard box \
                 allows: give both or neither",
            ));
        }
        Ok(GuardConsent::given(guard.map(Guard::from), self.accept_hard_stop))
    }
}
