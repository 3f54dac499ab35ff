//! Jobs as files in a folder that several computers share, such as one on NFS.
//!
//! | file | meaning |
//! | --- | --- |
//! | `folder.json` | program version, times by which a process counts as dead, number of tries |
//! | `jobs/FINGERPRINT` | an open job |
//! | `claims/FINGERPRINT.N` | try N of the job, from 0: exclusive, grows while its worker lives |
//! | `results/FINGERPRINT` | policy and learning curve, or the reason of the failure |
//! | `workers/NAME` | a worker: grows while it lives; `NAME.refused` has the reason of a refusal |
//! | `coordinators/N` | coordinator N of the folder, from 0: grows while it lives |
//! | `closed` | no further work follows |
//! | `logs/*` | the output of starts and workers, where this program starts the workers |
//!
//! A file that grows gets one byte at each beat of its process. All other files but the logs are
//! renamed into place, so that they appear whole, and have a checksum. Nothing relies on file
//! locks, which many NFS servers keep per computer, or on equal clocks. Two workers may do the same
//! job after one of them was taken for dead. They train the same policy and curve, and a job has
//! one result.

mod alive;
mod claim_name;
mod coordinator;
mod error;
mod heartbeat;
mod holder;
mod job_folder;
mod job_loop;
mod sealed;
mod terms;
mod tries;
mod worker;
mod worker_run;

pub use claim_name::ClaimName;
pub use coordinator::Coordinator;
pub use error::JobFolderError;
pub use heartbeat::{ClaimEnding, Heartbeat, HeartbeatState, HeartbeatWatch};
pub use holder::Holder;
pub use job_folder::{JobFolder, JobResult};
pub use terms::{Terms, program};
pub use tries::{NextTry, Tries};
pub use worker::{NotASlot, Slot, WorkReport, Worker, WorkerEvent};
