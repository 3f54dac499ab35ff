use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::error::JobFolderError;
use super::job_folder::refused;
use super::{Heartbeat, HeartbeatState, HeartbeatWatch, Holder, JobFolder};

/// The place of a process among the coordinators of a folder.
#[derive(Debug)]
pub struct Coordinator {
    /// Number of the coordinator, from 0; a successor has a higher number.
    pub number: u32,
    /// File that grows while the coordinator lives.
    pub heartbeat: Heartbeat,
}

impl JobFolder {
    /// Takes the folder for one coordinator, whose terms hold from then on. If the last coordinator
    /// has written no ending, and its process is unknown or ran on another computer, before this
    /// computer's last start or in another PID namespace, the function waits until that
    /// coordinator's heartbeat file either grows, which is an error, or counts as stale by the
    /// written terms and by the terms of this process.
    ///
    /// # Errors
    /// Another coordinator lives, `stop` was set during the wait, no number is left for another
    /// coordinator, or a file operation fails.
    pub fn coordinate(
        &self,
        holder: &Holder,
        stop: &AtomicBool,
    ) -> Result<Coordinator, JobFolderError> {
        // The last coordinator beats at the interval of the terms that it has written.
        let of_last = self.written_terms()?.map_or(Duration::ZERO, |terms| terms.stale());
        let mut watch = HeartbeatWatch::new(holder.clone(), self.terms().stale().max(of_last));
        let begun = std::time::Instant::now();
        let mut first = None;
        let pause = || {
            if stop.load(Ordering::Relaxed) {
                return Err(JobFolderError::Stopped { path: self.root().to_owned() });
            }
            std::thread::sleep(self.terms().beat().min(Duration::from_secs(1)));
            Ok(())
        };
        loop {
            let last = self.last_coordinator()?;
            let number = last.map_or(Ok(0), |last| self.number_after(last))?;
            if let Some(last) = last {
                let state = self.coordinator_state(last)?;
                let is_over = state.ending.is_some()
                    || watch.is_dead(&last.to_string(), &state, begun.elapsed());
                if !is_over {
                    let has_grown =
                        first.as_ref().is_some_and(|first| *first != (last, state.clone()));
                    let here = state
                        .holder
                        .as_ref()
                        .is_some_and(|it| it.host == holder.host && it.boot == holder.boot);
                    if has_grown || here {
                        let (path, by) = (self.root().to_owned(), state.creator());
                        return Err(JobFolderError::TwoCoordinators { path, by });
                    }
                    first.get_or_insert((last, state));
                    pause()?;
                    continue;
                }
            }
            let path = self.coordinator(number);
            match Heartbeat::create(self.disk(), &path, holder) {
                Ok(Some(heartbeat)) => {
                    self.write_terms()?;
                    return Ok(Coordinator { number, heartbeat });
                }
                // The file exists, although the listing of a shared folder does not show it yet.
                Ok(None) => pause()?,
                Err(source) => return Err(refused(&path, source)),
            }
        }
    }

    /// Checks that no other coordinator has taken the folder over from the coordinator with this
    /// number. A coordinator that was suspended for too long counts as dead and loses its folder.
    ///
    /// # Errors
    /// Another coordinator has taken the folder over ([`JobFolderError::TakenOver`]), or a file
    /// operation fails.
    pub fn check_coordinator(&self, number: u32) -> Result<(), JobFolderError> {
        match self.last_coordinator()? {
            Some(last) if last > number => Err(JobFolderError::TakenOver {
                path: self.root().to_owned(),
                by: self.coordinator_state(last).unwrap_or_default().creator(),
            }),
            _ => Ok(()),
        }
    }

    /// Returns whether the last coordinator lives, which `watch` judges at the time `now`.
    ///
    /// # Errors
    /// A file operation fails.
    pub(super) fn is_coordinated(
        &self,
        watch: &mut HeartbeatWatch,
        now: Duration,
    ) -> Result<bool, JobFolderError> {
        let Some(last) = self.last_coordinator()? else { return Ok(false) };
        let state = self.coordinator_state(last)?;
        Ok(state.ending.is_none() && !watch.is_dead(&last.to_string(), &state, now))
    }

    /// Number of the last coordinator; `None` if the folder has had none.
    fn last_coordinator(&self) -> Result<Option<u32>, JobFolderError> {
        let names = self.names("coordinators")?;
        Ok(names.into_iter().filter_map(|name| name.parse().ok()).max())
    }

    /// Number of the coordinator after another.
    ///
    /// # Errors
    /// The other one has the largest number, which only a stray file has.
    fn number_after(&self, last: u32) -> Result<u32, JobFolderError> {
        last.checked_add(1).ok_or_else(|| JobFolderError::Damaged {
            path: self.coordinator(last),
            reason: "no coordinator has had this number: remove the file".to_owned(),
        })
    }

    fn coordinator(&self, number: u32) -> PathBuf {
        self.root().join("coordinators").join(number.to_string())
    }

    fn coordinator_state(&self, number: u32) -> Result<HeartbeatState, JobFolderError> {
        let path = self.coordinator(number);
        let state = HeartbeatState::read(self.disk(), &path);
        Ok(state.map_err(|source| refused(&path, source))?.unwrap_or_default())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::jobs::folder::Terms;
    use crate::storage::MachineDisk;

    #[test]
    fn a_stray_file_with_the_largest_number_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let terms = Terms::default();
        let folder = JobFolder::create(Arc::new(MachineDisk), directory.path(), terms).unwrap();
        let stray = folder.coordinator(u32::MAX);
        std::fs::write(&stray, "").unwrap();
        let never = AtomicBool::new(false);
        let refused = folder.coordinate(&Holder::this_process(), &never).unwrap_err();
        assert!(matches!(&refused, JobFolderError::Damaged { path, .. } if *path == stray));
    }
}
