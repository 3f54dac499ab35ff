//! Stop requests by Ctrl-C, SIGTERM, SIGHUP, a key or the live view: a moving arm is braked, the
//! state is kept, and the exit code names the signal.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::exit::Failure;
use super::output::Output;
use super::printable::print_message;
use super::terminal;

/// Longest time that the answer to Ctrl-C delays the end of a command.
const LONGEST_ANSWER: Duration = Duration::from_millis(500);

/// Ends the program at the first Ctrl-C, SIGTERM or SIGHUP, for a command that only computes and
/// has no state to keep. The failure is its result for scripts.
pub fn end_at_signals() -> Result<(), Failure> {
    let failed = |error| Failure::failed(format!("signals cannot be handled: {error}"));
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).map_err(failed)?;
    let wait = move || {
        let Some(signal) = signals.forever().next() else { return };
        let print = move || {
            let stopped = Failure::interrupted(signal, "stopped: the result is not complete");
            if let Err(failure) = Output::new(true).finish(Err(stopped)) {
                failure.report();
            }
        };
        // Stdout may be a pipe from which nobody reads, and must not delay the end.
        if let Ok(printing) = std::thread::Builder::new().spawn(print) {
            let begun = Instant::now();
            while !printing.is_finished() && begun.elapsed() < LONGEST_ANSWER {
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        std::process::exit(128 + signal);
    };
    std::thread::Builder::new().name("signals".into()).spawn(wait).map(drop).map_err(failed)
}

/// A request to stop, set by a signal, a key or the live view.
#[derive(Clone, Debug, Default)]
pub struct Stop {
    /// Flag of the request, which the control thread and the trainings watch.
    pub flag: Arc<AtomicBool>,
    signal: Arc<AtomicUsize>,
    answer: Arc<Mutex<&'static str>>,
    /// True while the answer to the first Ctrl-C is printed.
    is_answering: Arc<AtomicBool>,
}

impl Stop {
    /// Installs the handlers of the signals for a command that moves a Qube. The first Ctrl-C
    /// requests a stop, even if a key, the live view or another signal has already done so. A
    /// second Ctrl-C ends the program at once; the device's watchdog then switches the motor off.
    pub fn on_signals() -> Result<Self, Failure> {
        Self::saying("stopping: the arm is braked and the state is kept")
    }

    /// Installs the handlers of the signals, as [`on_signals`](Self::on_signals) does, for a
    /// command that moves nothing. `answer` is printed after the first Ctrl-C.
    pub fn saying(answer: &'static str) -> Result<Self, Failure> {
        let flag = Arc::new(AtomicBool::new(false));
        let signal = Arc::new(AtomicUsize::new(0));
        let handlers =
            |error: String| Failure::failed(format!("signals cannot be handled: {error}"));
        let (interrupt, interrupted_by) = (Arc::clone(&flag), Arc::clone(&signal));
        let interrupted = AtomicBool::new(false);
        let answer = Arc::new(Mutex::new(answer));
        let answered = Arc::clone(&answer);
        let is_answering = Arc::new(AtomicBool::new(false));
        let answering = Arc::clone(&is_answering);
        ctrlc::set_handler(move || {
            if interrupted.swap(true, Ordering::Relaxed) {
                terminal::leave();
                std::process::exit(128 + SIGINT);
            }
            answering.store(true, Ordering::Relaxed);
            interrupt.store(true, Ordering::Relaxed);
            // After SIGTERM or SIGHUP, a Ctrl-C does not change the exit code. Their handlers store
            // the signal before they set the flag, so the flag does not show which came first.
            let _ = interrupted_by.compare_exchange(
                0,
                SIGINT as usize,
                Ordering::Relaxed,
                Ordering::Relaxed,
            );
            let answer = *answered.lock().unwrap_or_else(PoisonError::into_inner);
            // Printing to a halted terminal or a full pipe may block, and must not delay the second
            // Ctrl-C.
            let said = Arc::clone(&answering);
            let say = move || {
                print_message(&format!("\n{answer} (Ctrl-C again ends the program at once)"));
                said.store(false, Ordering::Relaxed);
            };
            if std::thread::Builder::new().name("answer".into()).spawn(say).is_err() {
                answering.store(false, Ordering::Relaxed);
            }
        })
        .map_err(|error| handlers(error.to_string()))?;
        for kind in [SIGTERM, SIGHUP] {
            signal_hook::flag::register_usize(kind, Arc::clone(&signal), kind as usize)
                .and_then(|_| signal_hook::flag::register(kind, Arc::clone(&flag)))
                .map_err(|error| handlers(error.to_string()))?;
        }
        Ok(Self { flag, signal, answer, is_answering })
    }

    /// Replaces the words that are printed after the first Ctrl-C.
    pub fn say(&self, answer: &'static str) {
        *self.answer.lock().unwrap_or_else(PoisonError::into_inner) = answer;
    }

    /// Returns whether a stop was requested.
    pub fn requested(&self) -> bool {
        self.flag.load(Ordering::Relaxed)
    }

    /// Returns the failure that ends a stopped command, with the exit code of its signal. A stop by
    /// a key or by the live view has the exit code of Ctrl-C. The answer to Ctrl-C comes first,
    /// unless the terminal takes no text.
    pub fn failure(&self, message: impl ToString) -> Failure {
        let ended = Instant::now();
        while self.is_answering.load(Ordering::Relaxed) && ended.elapsed() < LONGEST_ANSWER {
            std::thread::sleep(Duration::from_millis(5));
        }
        let signal = match self.signal.load(Ordering::Relaxed) {
            0 => SIGINT,
            signal => signal as i32,
        };
        Failure::interrupted(signal, message)
    }
}
