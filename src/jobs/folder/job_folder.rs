use std::collections::{BTreeSet, HashMap};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::error::JobFolderError;
use super::sealed::{NotSealed, sealed, unsealed};
use super::terms::{Terms, program};
use super::{ClaimName, Heartbeat, HeartbeatState, Holder};
use crate::elementary::Level;
use crate::jobs::TrainingJob;
use crate::learning::{TrainError, Trained, TrainedBytesError};
use crate::storage::{Disk, file_exists, is_absence, is_unfinished, write_whole};

/// Largest file with a job, the terms or a refusal that is read, bytes. A job has some kB.
const MAX_JOB_BYTES: u64 = 16 << 20;

/// Largest result file that is read, bytes. A policy has about 20 kB, and a learning curve about
/// 100 bytes for each update.
const MAX_RESULT_BYTES: u64 = 256 << 20;

/// The result of a job with the worker that carried it out.
#[derive(Debug)]
pub struct JobResult {
    /// Worker that carried the job out.
    pub by: String,
    /// Policy and learning curve, or the reason why the training failed.
    pub outcome: Result<Box<Trained>, String>,
}

/// First line of a result's payload.
#[derive(Serialize, Deserialize)]
struct ResultHeader {
    by: String,
    program: String,
    /// Instruction set of the training; it does not change the result.
    level: String,
    error: Option<String>,
}

/// The reason why a file of the folder is refused.
#[derive(Debug, Error)]
enum JobFileDefect {
    #[error(transparent)]
    NotSealed(#[from] NotSealed),
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    #[error(transparent)]
    Trained(#[from] TrainedBytesError),
    #[error("it contains another job than its name says")]
    OtherJob,
    /// The result is of the program with this name and version.
    #[error("{0}, another version, wrote it")]
    OtherProgram(String),
}

impl JobFileDefect {
    /// The error of the file at this path.
    fn in_file(self, path: &Path) -> JobFolderError {
        JobFolderError::Damaged { path: path.to_owned(), reason: self.to_string() }
    }
}

/// A folder of jobs.
#[derive(Clone, Debug)]
pub struct JobFolder {
    disk: Arc<dyn Disk>,
    root: PathBuf,
    terms: Terms,
}

impl JobFolder {
    /// Creates the folder with these terms. A folder that exists keeps the terms in its
    /// `folder.json` until [`coordinate`](Self::coordinate) succeeds.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn create(disk: Arc<dyn Disk>, root: &Path, terms: Terms) -> Result<Self, JobFolderError> {
        let folder = Self { disk, root: root.to_owned(), terms };
        for name in ["jobs", "claims", "results", "workers", "coordinators"] {
            let path = root.join(name);
            folder.disk.create_folder(&path).map_err(|source| refused(&path, source))?;
        }
        let terms = folder.terms_file();
        if !file_exists(folder.disk(), &terms).map_err(|source| refused(&terms, source))? {
            folder.write_terms()?;
        }
        Ok(folder)
    }

    fn terms_file(&self) -> PathBuf {
        self.root.join("folder.json")
    }

    /// The terms in `folder.json`; `None` if the file is missing or damaged.
    pub(super) fn written_terms(&self) -> Result<Option<Terms>, JobFolderError> {
        let path = self.terms_file();
        match self.disk.read(&path, MAX_JOB_BYTES) {
            Ok(bytes) => Ok(terms_in(&bytes).ok()),
            Err(error) if is_absence(&error) || error.kind() == io::ErrorKind::FileTooLarge => {
                Ok(None)
            }
            Err(source) => Err(refused(&path, source)),
        }
    }

    /// Writes `folder.json` again if it does not contain the terms of this coordinator, because it
    /// is damaged or gone: no worker can begin without it. Returns whether it was written.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn restore_terms(&self) -> Result<bool, JobFolderError> {
        let is_whole = self.written_terms()?.is_some_and(|terms| terms == self.terms);
        if !is_whole {
            self.write_terms()?;
        }
        Ok(!is_whole)
    }

    pub(super) fn write_terms(&self) -> Result<(), JobFolderError> {
        let path = self.terms_file();
        self.write(&path, "terms", &json(&path, &self.terms)?)
    }

    /// Opens the folder for a worker.
    ///
    /// # Errors
    /// The folder has no `folder.json`, this file is damaged or names another version of the
    /// program, or a file operation fails.
    pub fn open(disk: Arc<dyn Disk>, root: &Path) -> Result<Self, JobFolderError> {
        let path = root.join("folder.json");
        let bytes = disk.read(&path, MAX_JOB_BYTES).map_err(|source| {
            if is_absence(&source) {
                JobFolderError::NotAFolderOfJobs { path: root.to_owned() }
            } else {
                unread(&path, source)
            }
        })?;
        let terms = terms_in(&bytes).map_err(|defect| defect.in_file(&path))?;
        if !terms.are_of_this_program() {
            let (path, here, there) = (root.to_owned(), program(), terms.program);
            return Err(JobFolderError::OtherProgram { path, here, there });
        }
        Ok(Self { disk, root: root.to_owned(), terms })
    }

    /// Path of the folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The terms of the folder.
    #[must_use]
    pub fn terms(&self) -> &Terms {
        &self.terms
    }

    /// The disk of the folder.
    #[must_use]
    pub fn disk(&self) -> &dyn Disk {
        self.disk.as_ref()
    }

    /// Puts a job into the folder; returns its fingerprint, which is its name.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn put(&self, job: &TrainingJob) -> Result<String, JobFolderError> {
        let name = job.fingerprint();
        let path = self.job(&name);
        self.write(&path, "job", &json(&path, job)?)?;
        Ok(name)
    }

    /// The names of the open jobs.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn open_jobs(&self) -> Result<BTreeSet<String>, JobFolderError> {
        Ok(self.names("jobs")?.into_iter().collect())
    }

    /// Returns whether a job is open.
    #[must_use]
    pub fn is_open(&self, name: &str) -> bool {
        self.disk.exists(&self.job(name))
    }

    /// Reads an open job; `None` if the job is not open.
    ///
    /// # Errors
    /// The file is damaged, or a file operation fails.
    pub fn read_job(&self, name: &str) -> Result<Option<TrainingJob>, JobFolderError> {
        let path = self.job(name);
        let damaged = |defect: JobFileDefect| defect.in_file(&path);
        let bytes = match self.disk.read(&path, MAX_JOB_BYTES) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(unread(&path, source)),
        };
        let json = unsealed("job", &bytes).map_err(|error| damaged(error.into()))?;
        let job: TrainingJob =
            serde_json::from_slice(json).map_err(|error| damaged(error.into()))?;
        if job.fingerprint() != name {
            return Err(damaged(JobFileDefect::OtherJob));
        }
        Ok(Some(job))
    }

    /// The names of the jobs with a result.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn results(&self) -> Result<BTreeSet<String>, JobFolderError> {
        Ok(self.names("results")?.into_iter().collect())
    }

    /// Returns whether a job has a result.
    #[must_use]
    pub fn has_result(&self, name: &str) -> bool {
        self.disk.exists(&self.result(name))
    }

    /// Stores the result of a job. If two workers finish the same job, the later result replaces
    /// the earlier one. Both have the same policy and curve; only the worker's name and its
    /// instruction set may differ.
    ///
    /// # Errors
    /// A file operation fails; no result appears.
    pub fn write_result(
        &self,
        name: &str,
        by: &Holder,
        outcome: Result<&Trained, &TrainError>,
    ) -> Result<(), JobFolderError> {
        let header = ResultHeader {
            by: by.to_string(),
            program: program(),
            level: format!("{:?}", Level::best()),
            error: outcome.err().map(ToString::to_string),
        };
        let path = self.result(name);
        let mut payload = json(&path, &header)?;
        payload.push(b'\n');
        if let Ok(trained) = outcome {
            payload.extend(trained.to_bytes());
        }
        self.write(&path, "result", &payload)
    }

    /// Reads the result of a job.
    ///
    /// # Errors
    /// There is no result, the result is damaged, another version of the program wrote it, or a
    /// file operation fails.
    pub fn read_result(&self, name: &str, job: &TrainingJob) -> Result<JobResult, JobFolderError> {
        let path = self.result(name);
        let damaged = |defect: JobFileDefect| defect.in_file(&path);
        let bytes = self.disk.read(&path, MAX_RESULT_BYTES);
        let bytes = bytes.map_err(|source| unread(&path, source))?;
        let payload = unsealed("result", &bytes).map_err(|error| damaged(error.into()))?;
        let end = payload.iter().position(|byte| *byte == b'\n').unwrap_or(payload.len());
        let (header, trained) = payload.split_at(end);
        let header: ResultHeader =
            serde_json::from_slice(header).map_err(|error| damaged(error.into()))?;
        if header.program != program() {
            return Err(damaged(JobFileDefect::OtherProgram(header.program)));
        }
        let outcome = match header.error {
            Some(reason) => Err(reason),
            None => {
                let bytes = trained.get(1..).unwrap_or_default();
                let trained =
                    Trained::from_bytes(bytes, &job.distribution, &job.settings, job.seed);
                Ok(Box::new(trained.map_err(|error| damaged(error.into()))?))
            }
        };
        Ok(JobResult { by: header.by, outcome })
    }

    /// Removes the damaged file of a job; the coordinator then writes it again.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn discard_job(&self, name: &str) -> Result<(), JobFolderError> {
        self.remove(&self.job(name))
    }

    /// Removes the result of a job, so that it is done again.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn discard_result(&self, name: &str) -> Result<(), JobFolderError> {
        self.remove(&self.result(name))
    }

    /// Removes a job with its claims and its result. A worker that is carrying the job out finds no
    /// job and drops its own result.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn remove_job(&self, name: &str) -> Result<(), JobFolderError> {
        self.remove(&self.job(name))?;
        for number in 0.. {
            let path = self.claim(name, number);
            if !self.disk.exists(&path) {
                break;
            }
            self.remove(&path)?;
        }
        self.discard_result(name)
    }

    /// The number of tries begun of each job that has a claim in the folder, by the job's name.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn claims(&self) -> Result<HashMap<String, u32>, JobFolderError> {
        let mut claims = HashMap::new();
        for name in self.names("claims")? {
            if let Some(ClaimName { job, number }) = ClaimName::parse(&name) {
                let tries: &mut u32 = claims.entry(job.to_owned()).or_default();
                *tries = (*tries).max(number + 1);
            }
        }
        Ok(claims)
    }

    /// Path of the file by which a worker claims try `number`, from 0, of a job.
    #[must_use]
    pub fn claim(&self, name: &str, number: u32) -> PathBuf {
        self.root.join("claims").join(ClaimName { job: name, number }.to_string())
    }

    /// Registers a worker: creates its heartbeat file.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn register(&self, worker: &Holder) -> Result<Heartbeat, JobFolderError> {
        let path = self.root.join("workers").join(worker.file_name());
        self.remove(&path)?;
        match Heartbeat::create(self.disk(), &path, worker) {
            Ok(Some(heartbeat)) => Ok(heartbeat),
            Ok(None) => Err(refused(&path, io::ErrorKind::AlreadyExists.into())),
            Err(source) => Err(refused(&path, source)),
        }
    }

    /// Writes the reason why a worker refuses to work in this folder. A failure to write is
    /// ignored.
    pub fn write_refusal(disk: &dyn Disk, root: &Path, worker: &Holder, reason: &str) {
        let path = root.join("workers").join(worker.file_name() + ".refused");
        let _ = write_whole(disk, &path, &sealed("refusal", reason.as_bytes()));
    }

    /// The names of the workers' files: heartbeats and refusals.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn worker_files(&self) -> Result<Vec<String>, JobFolderError> {
        self.names("workers")
    }

    /// Reads the state of a worker's heartbeat file; `None` if the file does not exist.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn worker(&self, name: &str) -> Result<Option<HeartbeatState>, JobFolderError> {
        let path = self.root.join("workers").join(name);
        HeartbeatState::read(self.disk(), &path).map_err(|source| refused(&path, source))
    }

    /// Reads the reason why a worker refused; `None` if its file cannot be read.
    #[must_use]
    pub fn refusal(&self, name: &str) -> Option<String> {
        let bytes = self.disk.read(&self.root.join("workers").join(name), MAX_JOB_BYTES).ok()?;
        unsealed("refusal", &bytes).ok().map(|text| String::from_utf8_lossy(text).into_owned())
    }

    /// Tells the workers that no further work follows: they stop.
    ///
    /// # Errors
    /// A file operation fails.
    pub fn close(&self) -> Result<(), JobFolderError> {
        self.write(&self.root.join("closed"), "end", b"")
    }

    /// Undoes [`close`](Self::close).
    ///
    /// # Errors
    /// A file operation fails.
    pub fn reopen(&self) -> Result<(), JobFolderError> {
        self.remove(&self.root.join("closed"))
    }

    /// Returns whether the folder is closed: no further work follows.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.disk.exists(&self.root.join("closed"))
    }

    fn job(&self, name: &str) -> PathBuf {
        self.root.join("jobs").join(name)
    }

    fn result(&self, name: &str) -> PathBuf {
        self.root.join("results").join(name)
    }

    /// The names of the finished files in one of the folder's subfolders.
    pub(super) fn names(&self, part: &str) -> Result<Vec<String>, JobFolderError> {
        let path = self.root.join(part);
        let names = self.disk.names(&path).map_err(|source| refused(&path, source))?;
        let names = names.into_iter().filter(|name| !is_unfinished(name));
        Ok(names.filter_map(|name| name.into_string().ok()).collect())
    }

    fn write(&self, path: &Path, kind: &str, payload: &[u8]) -> Result<(), JobFolderError> {
        write_whole(self.disk(), path, &sealed(kind, payload))
            .map_err(|error| refused(path, error.source))
    }

    fn remove(&self, path: &Path) -> Result<(), JobFolderError> {
        match self.disk.remove(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(refused(path, error)),
            _ => Ok(()),
        }
    }
}

/// The terms in the bytes of a `folder.json`.
///
/// # Errors
/// The file is damaged.
fn terms_in(bytes: &[u8]) -> Result<Terms, JobFileDefect> {
    Ok(serde_json::from_slice(unsealed("terms", bytes)?)?)
}

/// A value as JSON for the file at `path`.
fn json(path: &Path, value: &impl Serialize) -> Result<Vec<u8>, JobFolderError> {
    serde_json::to_vec(value).map_err(|error| refused(path, error.into()))
}

/// The error of a file that could not be read: no file of this folder is as long as its limit, so a
/// longer file is damaged.
fn unread(path: &Path, source: io::Error) -> JobFolderError {
    match source.kind() {
        io::ErrorKind::FileTooLarge => {
            JobFolderError::Damaged { path: path.to_owned(), reason: source.to_string() }
        }
        _ => refused(path, source),
    }
}

pub(super) fn refused(path: &Path, source: io::Error) -> JobFolderError {
    JobFolderError::Disk { path: path.to_owned(), source }
}
