//! Ctrl-Z (SIGTSTP), which the keyboard takes so that the shell gets its terminal back.

use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::SIGTSTP;

/// True if the signal has come since the last [`Suspension::was_asked`].
static ASKED: AtomicBool = AtomicBool::new(false);

/// A handler of SIGTSTP, which replaces the system's own reaction until it is dropped.
#[derive(Debug)]
pub struct Suspension(());

impl Suspension {
    /// Installs the handler of the signal.
    pub fn take_over() -> Self {
        ASKED.store(false, Ordering::Relaxed);
        take_signal();
        Self(())
    }

    /// Returns whether the signal has come since the last call.
    pub fn was_asked(&self) -> bool {
        ASKED.swap(false, Ordering::Relaxed)
    }

    /// Suspends the program as the system does by itself, and returns when it is continued. Where
    /// no shell could continue it, as in a terminal of its own, the system ignores the signal, and
    /// this function returns at once. (`emulate_default_handler` of signal-hook suspends the
    /// program even there.)
    pub fn suspend(&self) {
        set_handler(libc::SIG_DFL);
        // SAFETY: `raise` has no precondition.
        unsafe { libc::raise(SIGTSTP) };
        take_signal();
    }
}

impl Drop for Suspension {
    fn drop(&mut self) {
        set_handler(libc::SIG_DFL);
    }
}

fn take_signal() {
    set_handler(note as extern "C" fn(libc::c_int) as libc::sighandler_t);
}

/// Sets the reaction to SIGTSTP. The crate signal-hook cannot do this, because it never restores
/// the system's own reaction.
fn set_handler(handler: libc::sighandler_t) {
    // SAFETY: the handler is the system's own, or `note`, which only stores to an atomic.
    unsafe { libc::signal(SIGTSTP, handler) };
}

extern "C" fn note(_: libc::c_int) {
    ASKED.store(true, Ordering::Relaxed);
}
