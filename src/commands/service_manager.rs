//! Notifications to systemd, if systemd has started this program (`Type=notify`, `WatchdogSec=`);
//! otherwise nothing happens.

use sd_notify::{NotifyState, notify};

/// Reports that the session has begun.
pub fn ready() {
    tell(NotifyState::Ready);
}

/// Reports that work was finished. The work itself reports, rather than a separate thread, so that
/// a session that hangs sends no report and systemd restarts it.
pub fn alive() {
    tell(NotifyState::Watchdog);
}

/// Reports that the session is over.
pub fn stopping() {
    tell(NotifyState::Stopping);
}

fn tell(state: NotifyState) {
    // A service manager that does not listen is not a reason to stop.
    if let Err(error) = notify(&[state]) {
        tracing::debug!("the service manager could not be told: {error}");
    }
}
