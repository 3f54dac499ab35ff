use std::path::PathBuf;
use std::time::Instant;

use super::controller::RunController;
use super::results::RunResults;
use crate::commands::destination::recording_of;
use crate::commands::exit::Failure;
use crate::commands::keyboard::Keyboard;
use crate::commands::live::Live;
use crate::commands::printable::print_message;
use crate::commands::screen::{Progress, time_left};
use crate::commands::stop::Stop;
use crate::commands::{command_hints, failures, warn_without_realtime};
use crate::control::HomingMethod;
use crate::rig::{NotBegun, Recorded, Rig, RigError, RigSettings, RolloutPlan};
use crate::storage::MachineDisk;
use crate::telemetry::{Ending, Fault};

/// Several rollouts of one policy or excitation on one rig.
pub struct RolloutSeries<'a> {
    pub settings: RigSettings,
    /// The driven Qube in words.
    pub described: String,
    pub plan: RolloutPlan,
    pub controller: RunController,
    pub directory: PathBuf,
    pub stop: &'a Stop,
    pub keyboard: &'a Keyboard,
    pub live: &'a Live,
    pub progress: Progress,
}

impl RolloutSeries<'_> {
    /// Runs the rollouts and adds their results to `results`, also the results from before a
    /// failure or a stop. A void last rollout is a failure.
    pub fn run(&mut self, rollouts: u32, results: &mut RunResults) -> Result<(), Failure> {
        self.progress.update(|state| {
            state.phase = "opening the Qube, checking and homing it".into();
            state.done = Some((0, rollouts.into()));
            state.has_trainings = false;
        });
        let mut rig = self.open()?;
        let began = Instant::now();
        warn_without_realtime(rig.realtime());
        for rollout in 0..rollouts {
            self.live.rollout(rollout, rollouts);
            self.progress.update(|state| {
                state.work = format!("rollout {rollout} ({} of {rollouts})", rollout + 1);
                state.phase = "rollouts on the Qube".into();
            });
            let recorded;
            (rig, recorded) = self.rollout(rig, rollout)?;
            results.add(&recorded.path)?;
            self.live.returned(results.rollouts.last().and_then(|it| it.return_));
            if let Ending::LeftBox(limit) = recorded.outcome.ending
                && let Some(hint) = command_hints::after_limit(limit)
            {
                print_message(hint);
            }
            if self.stop.requested() {
                break;
            }
            let last = rollout + 1 == rollouts;
            let done = u64::from(rollout) + 1;
            self.progress.update(|state| {
                state.done = Some((done, rollouts.into()));
                let to_do = u64::from(rollouts) - done;
                state.expect_end(time_left(began.elapsed(), done as f64, to_do as f64));
                state.best = results.best();
                if let Some(row) = results.rollouts.last() {
                    state.add_message(&format!("rollout {rollout}: {}", row.in_words()));
                }
            });
            if !last {
                self.progress.wait_while_paused(&self.stop.flag);
                if self.stop.requested() {
                    break;
                }
            }
            if let Ending::Fault(fault) = recorded.outcome.ending
                && !last
            {
                rig = self.after_fault(rig, fault)?;
            }
        }
        self.end(&rig, results)
    }

    /// Returns the outcome of the series after its last rollout.
    fn end(&self, rig: &Rig, results: &RunResults) -> Result<(), Failure> {
        // The device may not have confirmed that the motor is off; the recording of the last
        // rollout does not show this.
        let unconfirmed = rig.check_off().err();
        if self.stop.requested() {
            let message = "stopped; the recordings are complete up to here";
            let doubt = rig.last_fault().filter(|fault| fault.leaves_doubt());
            return Err(match (unconfirmed, doubt) {
                (Some(error), _) => {
                    failures::rig(error, self.stop).preceded_by(&format!("{message}; but"))
                }
                // The fault ended a rollout just before the stop, and the next start needs the
                // operator's acknowledgement.
                (None, Some(fault)) => Failure::fault(fault_message(fault))
                    .caused_by(Some(fault))
                    .preceded_by(&format!("{message}; but")),
                (None, None) => self.stop.failure(message),
            });
        }
        match (rig.last_fault().or(results.fault()), unconfirmed) {
            (Some(Fault::OffUnconfirmed) | None, Some(error)) => {
                Err(failures::rig(error, self.stop))
            }
            (Some(fault), unconfirmed) => {
                let failure = Failure::fault(fault_message(fault)).caused_by(Some(fault));
                Err(match unconfirmed {
                    Some(error) => failure.preceded_by(&error.to_string()),
                    None => failure,
                })
            }
            (None, None) => results.check_not_void(),
        }
    }

    /// Opens the rig. If a doubt prevents this, a remembered one or one that the check or homing
    /// leaves, the operator may acknowledge it at a terminal, and the rig is opened again.
    fn open(&mut self) -> Result<Rig, Failure> {
        let opened = match self.open_once() {
            Err(error) if self.acknowledges(&error) => {
                self.settings.recovery.acknowledged = true;
                self.settings.recovery.doubt = error.doubt().cloned();
                self.open_once()
            }
            opened => opened,
        };
        self.settings.recovery.acknowledged = false;
        self.settings.recovery.doubt = None;
        opened.map_err(|error| failures::rig(error, self.stop))
    }

    /// Opens the rig. Once port, board and doubt are accepted, prints how the arm will move first.
    fn open_once(&self) -> Result<Rig, RigError> {
        Rig::open_announced(&self.settings, &self.stop.flag, |is_examined| {
            let described = &self.described;
            if is_examined {
                // After a doubt the check cannot be left out.
                let how = match self.settings.recovery.acknowledged {
                    true => "",
                    false => " (--skip-check leaves the check out)",
                };
                print_message(&format!(
                    "checking {described}: before all else the arm is pushed a little{how}"
                ));
            }
            if self.settings.homing.method == HomingMethod::Stops {
                print_message(&format!(
                    "homing: before the first rollout the arm of {described} looks for its stops"
                ));
            }
        })
    }

    /// Returns whether the error leaves a doubt, and the operator acknowledges it.
    fn acknowledges(&self, error: &RigError) -> bool {
        let method = self.settings.homing.method;
        error.doubt().is_some_and(|doubt| self.keyboard.acknowledges(doubt, method, self.stop))
    }

    /// Runs a rollout; if it does not begin, starts the rig again and repeats it. Returns the rig
    /// too, which is a newly opened one after an acknowledged doubt.
    fn rollout(&mut self, mut rig: Rig, rollout: u32) -> Result<(Rig, Recorded), Failure> {
        let plan = RolloutPlan { rollout, ..self.plan.clone() };
        let path = recording_of(&self.directory, rollout);
        let mut not_begun = NotBegun::default();
        loop {
            match rig.rollout(&MachineDisk, &path, plan.header(), self.controller.file(rollout)) {
                Ok(recorded) => return Ok((rig, recorded)),
                Err(error) if not_begun.may_repeat(&error) => {
                    print_message(&format!("rollout {rollout} is repeated: {error}"));
                    rig = match rig.start_again() {
                        Ok(()) => rig,
                        Err(error) => self.reopened(rig, error)?,
                    };
                }
                Err(error) => rig = self.reopened(rig, error)?,
            }
        }
    }

    /// Restarts the rig after a fault, if the fault allows it or the operator acknowledges the
    /// doubt.
    fn after_fault(&mut self, mut rig: Rig, fault: Fault) -> Result<Rig, Failure> {
        match rig.start_again() {
            Ok(()) => Ok(rig),
            Err(error) if error.doubt().is_some() => self.reopened(rig, error),
            Err(error @ RigError::Ended { .. }) => Err(failures::rig(error, self.stop)),
            Err(error) => {
                let failure = failures::rig(error, self.stop);
                Err(failure
                    .preceded_by(&format!("a fault ended the last rollout ({fault}), and then")))
            }
        }
    }

    /// Opens the rig anew if the error is a doubt that the operator acknowledges; any other error
    /// is the failure of the run.
    fn reopened(&mut self, rig: Rig, error: RigError) -> Result<Rig, Failure> {
        if !self.acknowledges(&error) {
            return Err(failures::rig(error, self.stop));
        }
        drop(rig);
        self.settings.recovery.acknowledged = true;
        self.settings.recovery.doubt = error.doubt().cloned();
        self.open()
    }
}

/// Returns the message for a fault that ended the last rollout, with the operator's next step.
fn fault_message(fault: Fault) -> String {
    let then = match fault.leaves_doubt() {
        true => format!(". {}", failures::THEN_ACKNOWLEDGE),
        false => String::new(),
    };
    let step = fault.operator_step().trim_end_matches('.');
    format!("the last rollout was ended by a fault: {fault}. {step}{then}")
}
