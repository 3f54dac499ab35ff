use std::str::FromStr;
use std::time::Duration;

use thiserror::Error;

use super::error::JobFolderError;
use super::{Holder, JobFolder};
use crate::elementary::Level;
use crate::learning::TrainError;

/// The number of a worker among the workers of a folder. It makes each worker begin at another
/// place in the list of jobs, so that they seldom try to claim the same job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Slot {
    /// Number of the worker, below `count`.
    pub number: u32,
    /// Number of workers.
    pub count: u32,
}

/// The error for a text that does not give a worker's number and the number of workers.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("give a worker's number and the number of workers, as 3/16")]
pub struct NotASlot;

impl FromStr for Slot {
    type Err = NotASlot;

    /// Reads `k/N` with `k` from 0 to N. Schedulers count from 0 or from 1, so N is accepted and
    /// means 0.
    fn from_str(text: &str) -> Result<Self, NotASlot> {
        let parsed: Option<(u32, u32)> = text
            .split_once('/')
            .and_then(|(number, count)| Some((number.parse().ok()?, count.parse().ok()?)));
        match parsed {
            Some((number, count)) if count > 0 && number <= count => {
                Ok(Self { number: number % count, count })
            }
            _ => Err(NotASlot),
        }
    }
}

/// An event of a worker.
#[derive(Debug)]
pub enum WorkerEvent<'a> {
    /// The worker has begun a training.
    Began {
        /// Fingerprint of the job.
        job: &'a str,
        /// Number of the try, from 0.
        number: u32,
    },
    /// The worker has finished a training, with or without success.
    Finished {
        /// Fingerprint of the job.
        job: &'a str,
        /// Best return in training, or the reason of the failure.
        outcome: Result<f64, &'a TrainError>,
        /// Wall time of the training.
        took: Duration,
    },
    /// A job file is damaged.
    Unreadable {
        /// Fingerprint of the job.
        job: &'a str,
        /// Reason.
        reason: String,
    },
    /// The worker finds no work and waits.
    Waiting,
}

/// The work that a worker has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorkReport {
    /// Number of policies trained.
    pub trained: u32,
    /// Number of trainings that failed and would fail on any computer.
    pub failed: u32,
}

/// A worker that carries out the jobs of a folder on one core.
#[derive(Debug)]
pub struct Worker {
    pub(super) folder: JobFolder,
    pub(super) holder: Holder,
    pub(super) slot: Option<Slot>,
    pub(super) linger: Duration,
}

impl Worker {
    /// A worker that ends after `linger` without work for it or any other worker.
    ///
    /// # Errors
    /// The program would train without fused multiply-add, and its policies would differ from the
    /// policies of other computers.
    pub fn new(
        folder: JobFolder,
        holder: Holder,
        slot: Option<Slot>,
        linger: Duration,
    ) -> Result<Self, JobFolderError> {
        let has_fma = Level::best() != Level::Plain || cfg!(target_arch = "aarch64");
        match has_fma {
            true => Ok(Self { folder, holder, slot, linger }),
            false => Err(JobFolderError::NoFma { host: holder.host }),
        }
    }
}
