//! Jobs as files in a folder that several computers share, such as one on NFS.
//!
//! | file | meaning |
//! | --- | --- |
//! | `folder.json` | program version, and the times by which a process counts as dead |
//! | `jobs/FINGERPRINT` | an open job |
//! | `claims/FINGERPRINT.N` | the Nth try of the job: created exclusively, grows while its worker lives |
//! | `results/FINGERPRINT` | policy and learning curve, or the reason of the failure |
//! | `workers/NAME` | a worker, likewise growing; `workers/NAME.refused` the reason why it refused |
//! | `coordinators/N` | the Nth coordinator of the folder, likewise growing |
//! | `closed` | the coordinator wants no further work |
//!
//! All files but the growing ones appear whole, by rename, with a checksum. Nothing relies on file locks, which are per
//! computer on many NFS servers, nor on equal clocks. Two workers may do the same job after one was taken for dead: they
//! train the same policy and curve, and a job has one result.

mod heartbeat;
mod holder;
mod job_folder;
mod sealed;
mod tries;
mod worker;

pub use heartbeat::{ClaimEnding, Heartbeat, HeartbeatState, HeartbeatWatch};
pub use holder::Holder;
pub use job_folder::{JobFolder, JobResult, Terms, program};
pub use tries::{NextTry, Tries};
pub use worker::{Slot, WorkReport, Worker, WorkerEvent};
