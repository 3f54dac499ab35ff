use std::sync::atomic::{AtomicBool, Ordering};

use super::LONGEST_WAIT;
use crate::jobs::patience::Patience;
use crate::jobs::{JobError, JobFolderError};
use crate::learning::TrainError;

/// A caller that waits for results. It repeats operations on the folder until its patience ends or
/// its stop flag is set.
pub(super) struct PatientCaller<'a> {
    pub(super) patience: Patience,
    pub(super) stop: &'a AtomicBool,
    pub(super) on_wait: fn(),
}

impl PatientCaller<'_> {
    /// Performs an operation on the folder, and repeats it while a file operation fails and the
    /// patience lasts. If the caller's stop flag is set meanwhile, the error is
    /// [`TrainError::Stopped`].
    pub(super) fn repeat<T>(
        &mut self,
        operation: impl Fn() -> Result<T, JobFolderError>,
    ) -> Result<T, JobError> {
        loop {
            match operation() {
                Ok(done) => {
                    self.patience.renew();
                    return Ok(done);
                }
                Err(error @ JobFolderError::Disk { .. }) if self.patience.lasts() => {
                    if self.stop.load(Ordering::Relaxed) {
                        return Err(TrainError::Stopped.into());
                    }
                    tracing::warn!("{error}");
                    (self.on_wait)();
                    std::thread::sleep(LONGEST_WAIT);
                }
                Err(error) => return Err(error.into()),
            }
        }
    }
}
