//! Tests starts with one fault each: no stop is touched hard while homing and settling, and in 14
//! of the 26 cases no fault is named wrongly. `scripts/harmless-homing` plays 10^4 of them; this is
//! a small number.

use crate::harmless::case::{Case, Start};
use crate::harmless::table::Row;
use crate::harmless::trial::play;

/// Seeds of the starts of each of the 26 cases: 260 starts in all.
const SEEDS: std::ops::Range<u64> = 0..10;

#[test]
fn whatever_is_wrong_homing_and_settling_touch_no_stop_hard() {
    println!("{}", Row::HEAD);
    for case in Case::ALL {
        let starts = SEEDS.map(|seed| Start::new(case, seed));
        let trials: Vec<_> = starts.map(|start| (start, play(&start))).collect();
        let row = Row::of(case, &trials);
        println!("{row} all harmless: {}", row.harmless);
        for (start, trial) in &trials {
            let because = format!("{case:?}, seed {}: {trial:?}", start.seed);
            assert!(trial.is_harmless() || case.is_by_hand(), "{because}");
            if trial.falls_short(start) {
                println!("falls short: {because}");
            }
            // In these cases there is no fault, it begins early, or a hand acts. The fault must be
            // named correctly (a weak motor may stay unnamed), and a hand must not lead to a wrong
            // sign. The other cases are only printed.
            let from_the_start = matches!(
                case,
                Case::Healthy
                    | Case::ThetaDeadFromTheStart
                    | Case::AlphaDeadFromTheStart
                    | Case::ThetaSign
                    | Case::AlphaSign
                    | Case::MotorSign
                    | Case::MotorWeak
                    | Case::BesideAStop
                    | Case::BesideAStopFalling
                    | Case::ThetaHalf
                    | Case::ThetaDouble
                    | Case::MotorOneSided
                    | Case::ArmPushed
                    | Case::PendulumHeld
            );
            assert!(!from_the_start || trial.is_named_rightly(start), "{because}");
        }
    }
}
