//! Tests a swing-up on the firmware with homing and recording, in the board's own time.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{Profile, QubeModel};
use qube_hil::rig::{Rig, RigSettings, RolloutPlan};
use qube_hil::scoring::{Verdict, score};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::Fault;

use crate::board_clock::rig_settings;
use crate::qube::Qube;
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

/// Largest number of attempts; there are several, because the policy may leave the box, and because
/// the computer may be too slow.
const ATTEMPTS: u32 = 4;

fn plan() -> RolloutPlan {
    RolloutPlan::single("test", "test")
}

fn swings_up(chip: Chip, policy: &Policy) {
    let Some(toolchain) = toolchain() else { return };
    let mut complaints = String::new();
    for _ in 0..ATTEMPTS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("rollout.mcap");
        let board = SimulatedBoard::start(toolchain, chip, Qube::new(0));
        // The check has its own test.
        let settings = RigSettings { skip_check: true, ..rig_settings(&board) };
        let stop = Arc::new(AtomicBool::new(false));
        let serial = Rig::connect(&settings, &stop).unwrap().identity().serial.clone();
        // The Qube is identified, because the guard of an unidentified one ends good swing-ups.
        let profile = Some(Profile::exact("nominal", &QubeModel::NOMINAL));
        let settings = RigSettings { board: Some(serial), profile, ..settings };
        let header = plan().header();
        let recorded = Rig::open(&settings, &stop)
            .and_then(|rig| rig.rollout(&MachineDisk, &path, header, &policy.to_bytes()));
        let recorded = match recorded {
            Ok(recorded) => recorded,
            Err(error) if error.fault().is_some_and(Fault::may_be_repeated) => {
                complaints += &format!("{error}\n");
                continue;
            }
            Err(error) => panic!("{error}"),
        };
        let simulated_s = board.time_us() as f64 * 1e-6;
        let summary = format!(
            "{:?}\n{simulated_s:.1} s simulated with {:.0} % of a core, {} us given up\n",
            recorded.outcome,
            100.0 * board.processor_s() / simulated_s,
            board.given_up_us(),
        );
        if let Verdict::Result { success: true, .. } = score(&MachineDisk, &path).unwrap() {
            println!("{}: {summary}", chip.name());
            assert_eq!(board.lost_bytes(), 0);
            return;
        }
        complaints += &summary;
    }
    panic!("no swing-up in {ATTEMPTS} attempts: {complaints}");
}

#[test]
fn the_classical_controller_swings_up_on_the_firmware() {
    let classical = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    swings_up(Chip::Atmega328p, &classical);
}

#[test]
fn a_trained_policy_swings_up_on_the_firmware() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let policy = Policy::load(&folder.join("policies/nominal.safetensors")).unwrap();
    swings_up(Chip::Atmega2560, &policy);
}
