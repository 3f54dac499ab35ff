use std::error::Error;
use std::fmt;

/// A failure of the vendor's library or of the card behind it. Its text is the cause, and the
/// operator's step as a second sentence where there is one.
#[derive(Clone, Debug, PartialEq)]
pub enum HilError {
    /// There is no file of the library.
    NoLibrary {
        /// Names under which the library was looked for.
        tried: String,
    },
    /// A file of the library is there, and the loader refuses it.
    NotLoaded {
        /// Name of the file, and the loader's reason.
        reason: String,
    },
    /// The library that was found lacks a function, so it is of another version.
    NoFunction {
        /// File name of the library.
        library: String,
        /// Missing function.
        function: &'static str,
    },
    /// The library cannot reach a card at this address.
    NoCard {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// Another program has opened the card.
    Busy {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// The library has no licence for this card.
    NoLicence {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// The user may not open the card.
    NotPermitted {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// The card has no watchdog, so nothing would switch the motor off if this program died.
    NoWatchdog {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// A function failed for another reason.
    Failed {
        /// Address of the card.
        port: String,
        /// Function of the library.
        function: &'static str,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// A call of the library has not returned in time, or the thread that makes the calls has
    /// ended.
    Hung {
        /// Address of the card.
        port: String,
        /// Function of the library, or `a call` if no function is under way.
        function: &'static str,
        /// Time since the function was called, s; without a function, the longest wait.
        waited_s: f64,
    },
    /// Arming was requested of a card that is not open, or whose last fault no hello has cleared.
    NotGreeted {
        /// Address of the card.
        port: String,
    },
    /// The thread that calls the library, or a counter that wakes it, could not be created; or the
    /// thread has ended.
    NoThread {
        /// Address of the card.
        port: String,
        /// The cause.
        reason: String,
    },
}

impl HilError {
    /// Returns whether the error is [`Self::Hung`], which counts as a link without samples and not
    /// as a wrong request.
    #[must_use]
    pub fn is_silence(&self) -> bool {
        matches!(self, Self::Hung { .. })
    }

    /// The cause, without the operator's step.
    #[must_use]
    pub fn cause(&self) -> String {
        match self {
            Self::NoLibrary { tried } => {
                format!("the vendor's HIL library was not found (tried {tried})")
            }
            Self::NotLoaded { reason } => {
                format!("the vendor's HIL library is here, but cannot be loaded: {reason}")
            }
            Self::NoFunction { library, function } => {
                format!("{library} has no function {function}, so it is of another version")
            }
            Self::NoCard { port, reason } => format!("{port} is not there: {reason}"),
            Self::Busy { port, reason } => format!("{port} is in use by another program: {reason}"),
            Self::NoLicence { port, reason } => format!("{port} may not be used: {reason}"),
            Self::NotPermitted { port, reason } => {
                format!("{port} may not be opened by this user: {reason}")
            }
            Self::NoWatchdog { port, reason } => {
                format!(
                    "{port} has no watchdog ({reason}): the motor would stay on if this program died, so \
                     it is not switched on"
                )
            }
            Self::Failed { port, function, reason } => {
                format!("{port}: {function} failed: {reason}")
            }
            Self::Hung { port, function, waited_s } => {
                format!(
                    "{port}: the vendor's library has not returned from {function} for {waited_s:.1} s"
                )
            }
            Self::NotGreeted { port } => {
                format!(
                    "{port} cannot be armed before a hello has opened it and cleared its last fault"
                )
            }
            Self::NoThread { port, reason } => {
                format!(
                    "{port}: the thread for the vendor's library could not start, or has ended: \
                     {reason}"
                )
            }
        }
    }

    /// The operator's step, as a sentence without its full stop; `None` if there is none.
    #[must_use]
    pub fn remedy(&self) -> Option<&'static str> {
        Some(match self {
            Self::NoLibrary { .. } => {
                "Install the vendor's package quanser-sdk, or name its libhil.so in the environment \
                 variable QUBE_HIL_LIBHIL"
            }
            Self::NotLoaded { .. } => {
                "Install the vendor's current package quanser-sdk for this computer's processor, or name \
                 another file in QUBE_HIL_LIBHIL"
            }
            Self::NoFunction { .. } => {
                "Install the vendor's current package quanser-sdk, or name another file in \
                 QUBE_HIL_LIBHIL"
            }
            Self::NoCard { .. } => {
                "Switch the Qube on, plug its USB cable in, and check that the address names this Qube's \
                 panel"
            }
            Self::Busy { .. } => "Stop that program first",
            Self::NoLicence { .. } => "Put the vendor's licence in place first",
            Self::NotPermitted { .. } => {
                "Install the vendor's udev rules, then plug the cable in again"
            }
            Self::Hung { .. } => {
                "Switch the Qube off at its own switch, end this program, and begin again"
            }
            Self::NoWatchdog { .. }
            | Self::Failed { .. }
            | Self::NotGreeted { .. }
            | Self::NoThread { .. } => return None,
        })
    }
}

impl fmt::Display for HilError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.cause())?;
        self.remedy().map_or(Ok(()), |remedy| write!(formatter, ". {remedy}"))
    }
}

impl Error for HilError {}
