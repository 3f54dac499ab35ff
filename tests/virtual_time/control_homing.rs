//! Tests starts with one fault each: no stop is touched hard while homing and settling, in 18 of
//! the 27 cases no fault is named wrongly, and in 25 no result is false.
//! `scripts/harmless-homing` plays 10^4 of them; this is a small number.

use qube_hil::telemetry::{Ending, Fault};

use crate::harmless::case::{Case, Qubes, Start};
use crate::harmless::table::Row;
use crate::harmless::trial::{Trial, play};

/// Seeds of the starts of each of the 27 cases: 270 starts in all.
const SEEDS: std::ops::Range<u64> = 0..10;

/// Largest number of the ten starts of a case whose fault may be named wrongly or not at all. The
/// numbers leave room around the shares that `docs/homing-trials.md` reports. Where both counts are
/// constant, only the order in which they stopped tells which encoder is frozen, and a lapse or a
/// jump may stay unseen.
fn most_misnamed(case: Case) -> usize {
    match case {
        Case::MotorDeadLater => 1,
        Case::ArmHeldLater => 3,
        Case::ThetaFrozen | Case::ThetaDead | Case::ThetaJump | Case::AlphaFrozen => 5,
        Case::AlphaJump => 7,
        Case::ThetaLapse | Case::AlphaLapse => 10,
        // In these cases there is no fault, it exists from the start or begins early, or a hand
        // acts. A weak motor may stay unnamed, and a hand must not lead to a wrong sign.
        Case::Healthy
        | Case::ThetaDeadFromTheStart
        | Case::AlphaDeadFromTheStart
        | Case::ThetaSign
        | Case::AlphaSign
        | Case::MotorSign
        | Case::MotorDead
        | Case::MotorHalf
        | Case::MotorWeak
        | Case::ArmHeld
        | Case::BesideAStop
        | Case::BesideAStopFalling
        | Case::ThetaHalf
        | Case::ThetaDouble
        | Case::MotorOneSided
        | Case::EncodersExchanged
        | Case::ArmPushed
        | Case::PendulumHeld => 0,
    }
}

/// Whether a start has the ending that its case demands. The swinging pendulum may hide a motor
/// that is dead from the start, so that homing times out.
fn is_named(start: &Start, trial: &Trial) -> bool {
    let timed_out = trial.ending == Ending::Fault(Fault::HomingTimedOut);
    trial.is_named_rightly(start) || start.case == Case::MotorDead && timed_out
}

/// Whether rollouts of this case may count although the arm's zero is wrong: counts that are lost
/// or jump while the arm is slow stay unseen.
fn may_be_counted_wrongly(case: Case) -> bool {
    matches!(case, Case::ThetaLapse | Case::ThetaJump)
}

#[test]
fn whatever_is_wrong_homing_and_settling_touch_no_stop_hard() {
    println!("{}", Row::HEAD);
    for case in Case::ALL {
        let starts = SEEDS.map(|seed| Start::new(case, seed, Qubes::Near));
        let trials: Vec<_> = starts.map(|start| (start, play(&start))).collect();
        let row = Row::of(case, &trials);
        println!("{row} all harmless: {}", row.harmless);
        for (start, trial) in &trials {
            let because = format!("{case:?}, seed {}: {trial:?}", start.seed);
            assert!(trial.is_harmless() || case.is_by_hand(), "{because}");
            assert!(trial.false_results == 0 || may_be_counted_wrongly(case), "{because}");
            if trial.falls_short(start) {
                println!("falls short: {because}");
            }
        }
        let misnamed: Vec<_> = trials.iter().filter(|(start, it)| !is_named(start, it)).collect();
        assert!(misnamed.len() <= most_misnamed(case), "{case:?}: {misnamed:#?}");
    }
}

#[test]
fn qubes_far_from_nominal_are_homed_and_touch_no_stop_hard() {
    // The first nine were not homed, or touched a stop at up to 8 rad/s, before settling lost gain
    // and the scale of the encoders allowed for lengths that are 20 % off.
    let seeds = [1009, 1018, 1020, 1081, 1229, 1244, 1275, 1449, 1984].into_iter().chain(0..10);
    for seed in seeds {
        let start = Start::new(Case::Healthy, seed, Qubes::Far);
        let trial = play(&start);
        assert!(trial.homed_after_s.is_some(), "seed {seed}: {trial:?}");
        assert!(trial.is_harmless(), "seed {seed}: {trial:?}");
    }
}
