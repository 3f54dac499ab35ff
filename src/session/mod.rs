//! Sessions: the method's algorithm, its ledger on disk, and resuming after a crash.
//!
//! The room may import `rig`, `scoring`, `jobs`, `learning`, `simulation`, `search`, `surrogate`,
//! `identification`, `recording`, `control`, `device`, `policy`, `estimation`, `safety`,
//! `telemetry`, `storage` and `qube`.
//!
//! Reading order: [`SessionState`] computes the state from the ledger's entries, [`next_step`]
//! computes the next step from the state, [`Session`] performs this step with a
//! [`Rig`](crate::rig::Rig), and [`score`](crate::scoring::score) scores a recording.
//!
//! ```
//! use qube_hil::session::{Entry, EntryError, Extent, Purpose, SessionState, Step, next_step};
//!
//! let mut state = SessionState::default();
//! let begins = Step::Propose { count: 6, purpose: Purpose::Initial };
//! assert_eq!(next_step(&state, &Extent::QUICK, None), begins);
//! for candidate in 0..6 {
//!     state.apply(&Entry::Proposed {
//!         candidate,
//!         purpose: Purpose::Initial,
//!         point: vec![0.1 * f64::from(candidate)],
//!         pending: Vec::new(),
//!         policy_of: None,
//!     })?;
//! }
//! let trains = Step::Train { candidates: (0..6).collect() };
//! assert_eq!(next_step(&state, &Extent::QUICK, None), trains);
//! // No rollout precedes the training of its policy.
//! let early = Entry::RolloutFinished { candidate: 0, rollout: 0, attempt: 0, rig: None };
//! assert_eq!(state.apply(&early), Err(EntryError::NotDue));
//! # Ok::<(), EntryError>(())
//! ```

mod attempt;
mod configuration;
mod configuration_error;
mod decision;
mod emulated_qube;
mod entry;
mod error;
mod event;
mod extent;
mod finished_rollout;
mod folder;
mod identification_settings;
mod ledger;
mod located_entries;
mod orchestrator;
mod paths;
mod plan;
mod profiles;
mod recorded_clock;
mod report;
mod retired;
mod rig_sessions;
mod rig_spread;
mod seeds;
mod setting_error;
mod settings;
mod settings_check;
mod settings_list;
mod settings_words;
mod state;
mod toml_message;
mod training_time;
mod view;

pub use attempt::{AttemptId, RolloutAttempt};
pub use configuration_error::ConfigurationError;
pub use decision::{GainSource, SearchEnd, WORTHWHILE_GAIN};
pub use emulated_qube::{EmulatedQubeError, EmulatedQubeSettings, LARGEST_VARY};
pub use entry::{Entry, Purpose};
pub use error::SessionError;
pub use event::SessionEvent;
pub use extent::Extent;
pub use finished_rollout::{check_origin, check_policy, finished_rollout};
pub use folder::{FolderError, SessionFolder, put_aside};
pub use identification_settings::IdentificationSettings;
pub use ledger::{DamagedLine, Ledger, LedgerError, Parsed, parse as parse_ledger};
pub(crate) use located_entries::entry_at;
pub use orchestrator::{Session, keep_on_board};
pub use paths::{PolicyPaths, SessionPaths, recording_in};
pub use plan::{CandidateCounts, Step, next_step, trains_ahead};
pub use profiles::identified_profile;
pub use recorded_clock::recorded_clock;
pub use report::{BestPolicy, EndedSearch, SessionReport};
pub use retired::{Retired, take_retired};
pub use rig_sessions::{RigSessions, run_side_by_side};
pub use rig_spread::rig_of_rollout;
pub use seeds::{SeedFor, derived_seed};
pub use setting_error::SettingError;
pub use settings::{SessionSettings, SharedRig};
pub use settings_list::{ChangedSetting, Setting};
pub use state::{
    Candidate, EntryError, FailedRefit, Finished, Identification, SessionState, StoredProfile,
    TakenOutRig, VoidAttempt,
};
pub(crate) use toml_message::toml_message;
pub use training_time::{TrainingTime, TrainingTimesError};
pub use view::{CandidateRank, RigResults, ScoredCandidate, ScoredRollout, SessionView};
