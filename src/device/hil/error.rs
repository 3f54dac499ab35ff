use thiserror::Error;

/// A failure of the vendor's library or of the card behind it.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum HilError {
    /// There is no file of the library.
    #[error(
        "the vendor's HIL library was not found (tried {tried}). Install the vendor's package quanser-sdk, or \
         name its libhil.so in the environment variable QUBE_HIL_LIBHIL"
    )]
    NoLibrary {
        /// Names under which the library was looked for.
        tried: String,
    },
    /// A file of the library is there, and the loader refuses it.
    #[error(
        "the vendor's HIL library is here, but cannot be loaded: {reason}. Install the vendor's current package \
         quanser-sdk for this computer's processor, or name another file in QUBE_HIL_LIBHIL"
    )]
    NotLoaded {
        /// Name of the file, and the loader's reason.
        reason: String,
    },
    /// The library that was found lacks a function, so it is of another version.
    #[error(
        "{library} has no function {function}, so it is of another version. Install the vendor's current \
         package quanser-sdk, or name another file in QUBE_HIL_LIBHIL"
    )]
    NoFunction {
        /// File name of the library.
        library: String,
        /// Missing function.
        function: &'static str,
    },
    /// The library finds no card at this address.
    #[error(
        "{port} is not there: {reason}. Switch the Qube on, plug its USB cable in, and check that the \
         address names this Qube's panel"
    )]
    NoCard {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// Another program has opened the card.
    #[error("{port} is in use by another program: {reason}. Stop that program first")]
    Busy {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// The library has no licence for this card.
    #[error("{port} may not be used: {reason}. Put the vendor's licence in place first")]
    NoLicence {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// The user may not open the card.
    #[error(
        "{port} may not be opened by this user: {reason}. Install the vendor's udev rules, then plug the \
         cable in again"
    )]
    NotPermitted {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// The card has no watchdog, so nothing would switch the motor off if this program died.
    #[error(
        "{port} has no watchdog ({reason}): the motor would stay on if this program died, so it is not \
         switched on"
    )]
    NoWatchdog {
        /// Address of the card.
        port: String,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// A function failed for another reason.
    #[error("{port}: {function} failed: {reason}")]
    Failed {
        /// Address of the card.
        port: String,
        /// Function of the library.
        function: &'static str,
        /// Error text of the vendor's library.
        reason: String,
    },
    /// A call of the library has not returned in time.
    #[error(
        "{port}: the vendor's library has not returned from {function} for {waited_s:.1} s. Switch the Qube \
         off at its own switch, end this program, and begin again"
    )]
    Hung {
        /// Address of the card.
        port: String,
        /// Function of the library.
        function: &'static str,
        /// Time since the function was called, s.
        waited_s: f64,
    },
    /// Arming was requested of a card that no hello has opened, or whose last fault no hello has
    /// cleared.
    #[error("{port} cannot be armed before a hello has opened it and cleared its last fault")]
    NotGreeted {
        /// Address of the card.
        port: String,
    },
    /// The thread that calls the library could not be started, or has ended.
    #[error("{port}: the thread for the vendor's library could not start, or has ended: {reason}")]
    NoThread {
        /// Address of the card.
        port: String,
        /// The cause.
        reason: String,
    },
}

impl HilError {
    /// Whether a call of the library has not returned in time, which counts as a link without
    /// samples and not as a wrong request.
    #[must_use]
    pub fn is_silence(&self) -> bool {
        matches!(self, Self::Hung { .. })
    }
}
