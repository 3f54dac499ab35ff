//! Turns the signal of a file beyond the limit for its size (`ulimit -f`) into an error.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use signal_hook::consts::SIGXFSZ;

/// Lets a write beyond the limit fail with an error, which names the file. By default the signal
/// SIGXFSZ would end the program without a message, before the motor is braked.
///
/// The signal gets a handler and is not ignored, because programs that this one starts would
/// inherit an ignored signal, but not a handler.
pub fn report_as_errors() {
    // Without the handler the signal keeps its effect; nothing else can be done about it here.
    let _ = signal_hook::flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)));
}
