//! Trainings as data, and the executors that carry them out.
//!
//! A [`TrainingJob`] holds everything that its policy depends on, so the same job gives the same
//! policy and learning curve wherever it runs. The command `train`, sessions and experiments hand
//! jobs to an [`Executor`]; [`LocalExecutor`] trains on this computer's cores, [`FolderExecutor`]
//! by workers on any computers that share a folder with this one ([`folder`]). Three kinds of
//! training are no jobs and run in the process that requests them: trainings that continue from a
//! network (`train --from`), trainings by methods with a training of their own, and trainings that
//! Python starts.
//!
//! The room may import `learning`, `simulation`, `storage` and `elementary`.
//!
//! ```
//! use std::sync::atomic::AtomicBool;
//!
//! use qube_hil::jobs::{Executor, LocalExecutor, TrainingJob};
//! use qube_hil::learning::TrainSettings;
//! use qube_hil::simulation::DomainDistribution;
//!
//! // Far too small to learn a swing-up.
//! let settings = TrainSettings { updates: 1, epochs: 1, ..TrainSettings::quick() };
//! let job = TrainingJob { distribution: DomainDistribution::nominal(), settings, seed: 1 };
//! let never = AtomicBool::new(false);
//! let trained = LocalExecutor::on_cores(1).train_one(&job, &never, &mut |_| ())?;
//! assert_eq!(trained.curve.len(), 1);
//! # Ok::<(), qube_hil::jobs::JobError>(())
//! ```

mod competition;
mod error;
mod executor;
pub mod folder;
mod folder_executor;
mod local;
mod patience;
pub mod starter;
mod training_cores;
mod training_job;
mod worker_pool;

pub use competition::{
    CHOSEN_OF_STARTS, Competition, ROUNDS, SUCCEEDED, TrainingScore, tenth_percentile,
};
pub use error::JobError;
pub use executor::{Executor, JobEvent, train_all};
pub use folder::JobFolderError;
pub use folder_executor::{AtEnd, FolderExecutor};
pub use local::LocalExecutor;
pub use training_job::TrainingJob;
