//! What systemd is told where it started this program (`Type=notify`, `WatchdogSec=`); elsewhere
//! nothing happens.

use sd_notify::{NotifyState, notify};

/// The session has begun.
pub fn ready() {
    tell(NotifyState::Ready);
}

/// Something was finished. Told by the work itself and not by a thread of its own, so that a session
/// that hangs falls silent and is restarted.
pub fn alive() {
    tell(NotifyState::Watchdog);
}

/// The session is over, one way or another.
pub fn stopping() {
    tell(NotifyState::Stopping);
}

fn tell(state: NotifyState) {
    // A service manager that does not listen is no reason to stop.
    if let Err(error) = notify(&[state]) {
        tracing::debug!("the service manager could not be told: {error}");
    }
}
