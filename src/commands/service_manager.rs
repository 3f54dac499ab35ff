//! Notifications to systemd, if systemd has started this program (`Type=notify`, `WatchdogSec=`);
//! otherwise nothing happens.

use sd_notify::NotifyState;

/// Reports that the session has begun.
pub fn ready() {
    notify(NotifyState::Ready);
}

/// Reports that the session makes progress. The session calls this function at each of its events,
/// and each thread that waits for a worker. So a session that hangs goes unnoticed while trainings
/// or other sessions run beside it; once they have ended, no report comes, and systemd restarts the
/// program. There is no thread only for reports, because it would hide every hang.
pub fn alive() {
    notify(NotifyState::Watchdog);
}

/// Reports that the session is over.
pub fn stopping() {
    notify(NotifyState::Stopping);
}

fn notify(state: NotifyState) {
    // A service manager that does not listen is not a reason to stop.
    if let Err(error) = sd_notify::notify(&[state]) {
        tracing::debug!("cannot notify the service manager: {error}");
    }
}
