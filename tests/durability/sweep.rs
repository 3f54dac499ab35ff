//! Tests a failure of the wire at the i-th operation, for each i of a whole run and each kind, or a
//! sample of these: every run ends with the amplifier off, and each recording is correct.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use qube_hil::control::HomingMethod;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::recording::read_on;
use qube_hil::rig::{Rig, RigError, RolloutPlan};
use qube_hil::safety::SafetyBox;
use qube_hil::scoring::{Verdict, VoidReason, score};
use qube_hil::storage::Disk;
use qube_hil::telemetry::{Ending, Fault, Phase};

use crate::count_from;
use crate::fault_port::{KINDS, Kind, Plan};
use crate::simulated_disk::SimulatedDisk;
use crate::world::{STEPS, Wiring};

/// The result of one run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum RunResult {
    /// The device could not be opened or homed; no rollout was begun.
    NotOpened(String),
    /// The device could not be armed; there is no recording.
    NotArmed(String),
    /// A valid rollout.
    Finished,
    /// A void rollout, with the text of its fault.
    Void(String),
}

/// Performs one run: hello, homing, settling, 60 steps, braking. Returns its result, the number of
/// operations on the wire, and the time from the last valid command until the amplifier went off,
/// us.
fn run(plan: Option<Plan>, method: HomingMethod) -> (RunResult, u64, u64) {
    let disk = SimulatedDisk::default();
    let wiring = Wiring::new(vec![plan], None, Arc::default());
    let stop = Arc::new(AtomicBool::new(false));
    let outcome = match Rig::open(&wiring.clone().rig_settings(method), &stop) {
        // Only a panic ends the control thread here, for instance one in a check of its wire.
        Err(error @ RigError::ThreadGone(_)) => panic!("{plan:?}: {error}"),
        Err(error) => {
            let is_over = plan.is_some_and(|plan| !plan.lasting);
            let is_timing_fault =
                matches!(error, RigError::Homing { fault, .. } if fault.may_be_repeated());
            let is_given_up = is_over && is_timing_fault;
            assert!(!is_given_up, "{plan:?}: homing was not tried again: {error}");
            RunResult::NotOpened(named(&error))
        }
        Ok(mut rig) => {
            let outcome = rollout(&rig, &disk);
            // A failure of a single operation is over, so the rig must recover by itself.
            if matches!(outcome, RunResult::Void(_))
                && plan.is_some_and(|plan| !plan.lasting && plan.kind != Kind::Rename)
            {
                rig.start_again().unwrap_or_else(|error| panic!("{plan:?}: {error}"));
            }
            outcome
        }
    };
    let operations = wiring.operations()[0];
    (outcome, operations, wiring.must_end_safe())
}

/// A rollout of 60 steps by the classical controller, with the bytes of its policy file.
pub fn rollout_plan() -> (RolloutPlan, Vec<u8>) {
    let plan = RolloutPlan {
        safety_box: SafetyBox::THESIS,
        steps: STEPS,
        ..RolloutPlan::single("sweep", "classical")
    };
    let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes();
    (plan, policy)
}

fn rollout(rig: &Rig, disk: &SimulatedDisk) -> RunResult {
    let path = Path::new("/rollout.mcap");
    let (plan, policy) = rollout_plan();
    let recorded = match rig.rollout(disk, path, plan.header(), &policy) {
        Ok(recorded) => recorded,
        Err(error @ (RigError::Device(_) | RigError::NotBegun { .. })) => {
            assert!(!disk.exists(path), "a rollout that never began left a file");
            return RunResult::NotArmed(named(&error));
        }
        Err(error) => panic!("{error}"),
    };
    // The recording must agree with the control thread's report.
    let recording = read_on(disk, path).unwrap();
    assert_eq!(recording.outcome.as_ref(), Some(&recorded.outcome));
    assert!(!recording.lacks_ticks() && recorded.outcome.records_lost == 0);
    let running = recording.ticks.iter().filter(|tick| tick.phase == Phase::Running).count();
    assert_eq!(running, recorded.outcome.steps as usize);
    let missed: u32 = recording
        .ticks
        .iter()
        .map(|tick| {
            let late = tick.lateness_ns > qube_hil::qube::CONTROL_PERIOD_NS;
            tick.skipped_periods + u32::from(tick.measurement.is_none() || late)
        })
        .sum();
    assert_eq!(missed, recorded.outcome.missed_deadlines, "not every missed deadline is marked");
    match (score(disk, path).unwrap(), recorded.outcome.ending) {
        (Verdict::Result { .. }, Ending::Completed | Ending::LeftBox(_)) => RunResult::Finished,
        (Verdict::Void { reason }, Ending::Fault(fault)) => {
            assert_eq!(reason, VoidReason::Fault(fault));
            RunResult::Void(reason.to_string())
        }
        other => panic!("{other:?}"),
    }
}

fn named(error: &RigError) -> String {
    let text = error.to_string();
    assert!(text.len() > 10, "an error without a sentence: {text}");
    text
}

/// The results of a sweep.
#[derive(Default)]
struct Tally {
    runs: u64,
    finished: u64,
    void: u64,
    not_begun: u64,
    longest_on_us: u64,
}

/// Runs all combinations (operation, kind, single or permanent), or one in `stride`.
fn sweep(method: HomingMethod, stride: u64) -> Tally {
    let (outcome, operations, _) = run(None, method);
    assert_eq!(outcome, RunResult::Finished, "a run without faults does not finish");
    let cases = KINDS.len() as u64 * 2 * operations;
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let next = AtomicU64::new(0);
    let tallies = std::thread::scope(|scope| {
        let work = || {
            let mut tally = Tally::default();
            loop {
                let case = next.fetch_add(stride, Ordering::Relaxed);
                if case >= cases {
                    return tally;
                }
                // Kinds alternate, so that a sample has all of them everywhere.
                let kind = KINDS[(case % KINDS.len() as u64) as usize];
                let rest = case / KINDS.len() as u64;
                let plan = Plan { operation: rest / 2, kind, lasting: rest % 2 == 1 };
                let _case = Case(plan);
                tally.count(plan, run(Some(plan), method));
            }
        };
        let threads: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
    });
    let mut sum = Tally::default();
    for tally in tallies {
        sum.runs += tally.runs;
        sum.finished += tally.finished;
        sum.void += tally.void;
        sum.not_begun += tally.not_begun;
        sum.longest_on_us = sum.longest_on_us.max(tally.longest_on_us);
    }
    println!(
        "failing wire, homing {method:?}: {operations} operations, {} runs: {} finished, {} void, \
         {} not begun; amplifier off at most {} us after the last valid command",
        sum.runs, sum.finished, sum.void, sum.not_begun, sum.longest_on_us
    );
    sum
}

/// Combination of a run, which is printed if the run panics.
struct Case(Plan);

impl Drop for Case {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the case that failed: {:?}", self.0);
        }
    }
}

impl Tally {
    fn count(&mut self, plan: Plan, (outcome, _, on_us): (RunResult, u64, u64)) {
        self.runs += 1;
        self.longest_on_us = self.longest_on_us.max(on_us);
        if plan.kind.is_ordinary() && !plan.lasting {
            assert_eq!(outcome, RunResult::Finished, "an ordinary failure ended the run: {plan:?}");
        }
        match outcome {
            RunResult::Finished => self.finished += 1,
            RunResult::Void(_) => self.void += 1,
            RunResult::NotOpened(_) | RunResult::NotArmed(_) => self.not_begun += 1,
        }
    }
}

#[test]
fn a_wire_that_fails_anywhere_in_any_way_leaves_the_amplifier_off_and_the_record_right() {
    // The default strides are primes, so that the sample covers every kind, single and lasting.
    let stride = count_from("QUBE_HIL_FAULT_SWEEP_STRIDE", 97);
    let tally = sweep(HomingMethod::Hand, stride);
    assert!(tally.finished > 0 && tally.void > 0 && tally.not_begun > 0);
    let stride = count_from("QUBE_HIL_FAULT_SWEEP_STOPS_STRIDE", 1499);
    sweep(HomingMethod::Stops, stride);
}

/// Tests that a port that is pulled and returns under another name can be used: a new link to the
/// same board arms and runs.
#[test]
fn a_device_that_comes_back_under_another_name_runs_again() {
    let (_, operations, _) = run(None, HomingMethod::Hand);
    let (mut voids, mut is_over) = (0, false);
    for operation in (0..operations).step_by(operations as usize / 24) {
        let plan = Plan { operation, kind: Kind::Rename, lasting: true };
        let wiring = Wiring::new(vec![Some(plan)], None, Arc::default());
        let stop = Arc::new(AtomicBool::new(false));
        let disk = SimulatedDisk::default();
        if let Ok(rig) = Rig::open(&wiring.clone().rig_settings(HomingMethod::Hand), &stop) {
            match rollout(&rig, &disk) {
                // A rollout that has not ended is void, because the port is gone.
                RunResult::Void(reason) => {
                    assert_eq!(reason, Fault::LinkGone.to_string(), "{plan:?}");
                    assert!(!is_over, "{plan:?}: an earlier loss of the port left a result");
                    voids += 1;
                }
                RunResult::Finished => is_over = true,
                RunResult::NotOpened(_) | RunResult::NotArmed(_) => {}
            }
        }
        let wire = wiring.last_wire().unwrap();
        let settings = wiring.reopened(wire).rig_settings(HomingMethod::Hand);
        let rig = Rig::open(&settings, &stop).unwrap_or_else(|error| panic!("{plan:?}: {error}"));
        let disk = SimulatedDisk::default();
        assert_eq!(rollout(&rig, &disk), RunResult::Finished, "{plan:?}");
    }
    assert!(voids > 0, "the port was never lost within a rollout");
}
