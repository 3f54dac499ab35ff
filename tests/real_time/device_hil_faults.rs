//! Tests every function of the vendor's library with every kind of fault: however a run ends, the
//! amplifier is off and the program has ended by itself. Each run is a whole process in real time,
//! and several run at once; a late computer only changes how a run ends.

use std::process::Stdio;
use std::sync::{Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};

use qube_hil::telemetry::Fault;

use crate::busy_computer::in_real_time;
use crate::panel::{Ended, Panel, library};

/// Time after which a process counts as hung.
const PATIENCE: Duration = Duration::from_secs(180);

/// Number of processes that run at once.
const AT_ONCE: usize = 12;

/// Largest number of repetitions of a run that has ended before its fault.
const AGAIN: u32 = 6;

/// Lock of the runs: first attempts share it, and a repetition has it for itself, because the other
/// runs would make it late again.
static RUNS: RwLock<()> = RwLock::new(());

/// Call numbers at which faults begin, for functions that are called when the amplifier is switched
/// on or off: at the start, around homing, around the rollout.
const RARE: &[u64] = &[1, 2, 4];

/// Call numbers at which faults begin, for the functions that are called before the amplifier is
/// switched on: once for homing, once for the rollout.
const ARMS: &[u64] = &[1, 2];

/// Call numbers at which faults begin, for the function that only a hello calls, twice.
const TEXTS: &[u64] = &[1, 2];

/// Call numbers at which faults begin, for the function that reads a sample in every tick.
const FREQUENT: &[u64] = &[1, 260, 420];

/// Call numbers at which faults begin, for the functions that every act calls.
const ACTS: &[u64] = &[1, 3, 150];

/// The functions, and the call numbers from which each fails, counted from 1.
const FUNCTIONS: [(&str, &[u64]); 13] = [
    ("hil_open", &[1]),
    ("hil_read", FREQUENT),
    ("hil_write_analog", ACTS),
    ("hil_write_digital", RARE),
    ("hil_watchdog_set_analog_expiration_state", &[1]),
    ("hil_watchdog_start", ARMS),
    ("hil_watchdog_reload", ACTS),
    ("hil_watchdog_clear", ARMS),
    ("hil_watchdog_stop", RARE),
    ("hil_get_string_property", TEXTS),
    ("hil_watchdog_set_digital_expiration_state", &[1]),
    ("hil_set_card_specific_options", &[1]),
    ("hil_close", &[1]),
];

/// The functions whose lasting fault leaves a rollout whole: two are called when the amplifier is
/// off, and the last one reads the card's serial number and firmware version.
const SPARED: [&str; 3] = ["hil_watchdog_stop", "hil_close", "hil_get_string_property"];

/// Faults after which the program asks whether the watchdog has expired: a read that fails within
/// the rollout, and one within homing that takes so long that the watchdog expires. After the first
/// one it also asks whether the card is still valid.
const ASKED_AFTER: [&str; 2] = ["hil_read:error=13:420:1", "hil_read:hang=120:300:1"];

/// The faults of the sweep, in the notation of the test library (`tests/hil/library.rs`). Without
/// `all`, each function fails only from its last call in [`FUNCTIONS`] on, and for good; the faults
/// of [`ASKED_AFTER`], of the counts and of the cable are always included.
fn faults(all: bool) -> Vec<String> {
    let mut faults = Vec::new();
    for (function, calls) in FUNCTIONS {
        let fewest = if all { 0 } else { calls.len() - 1 };
        for call in &calls[fewest..] {
            for kind in ["error=13", "hang=60"].iter().filter(|_| all) {
                faults.push(format!("{function}:{kind}:{call}:1"));
            }
            for kind in ["error=13", "hang=3600000"] {
                faults.push(format!("{function}:{kind}:{call}"));
            }
        }
    }
    for first in ASKED_AFTER {
        for kind in ["error=13", "hang=60", "hang=3600000"] {
            faults.push(format!("{first}+hil_watchdog_is_expired:{kind}:1"));
        }
    }
    for kind in ["error=13", "hang=60", "hang=3600000"] {
        faults.push(format!("{}+hil_is_valid:{kind}:1", ASKED_AFTER[0]));
    }
    let counts =
        ["jump=65536", "jump=-16777216", "jump-alpha=65536", "jump-alpha=16777216", "stale"];
    faults.extend(counts.map(|kind| format!("hil_read:{kind}:420")));
    faults.extend([260, 420].map(|call| format!("hil_read:unplug=2000:{call}")));
    faults
}

/// Makes a short run under one fault and panics, naming the fault, unless the run reaches the fault
/// and ends safely. A run that ends before the fault, as on a late computer, must end safely, too,
/// and is repeated alone.
fn run(fault: &str) -> Ended {
    let mut attempt = {
        let _beside_others = RUNS.read().unwrap_or_else(PoisonError::into_inner);
        run_once(fault)
    };
    for again in 1..=AGAIN {
        let (ended, is_met) = attempt;
        if is_met {
            return ended;
        }
        println!(
            "{fault}: begun again, {again} of at most {AGAIN} times, because the run ended before \
             the fault: {ended:?}"
        );
        let _alone = RUNS.write().unwrap_or_else(PoisonError::into_inner);
        attempt = run_once(fault);
    }
    let (ended, is_met) = attempt;
    assert!(is_met, "{fault}: the run ended before the fault {} times: {ended:?}", AGAIN + 1);
    ended
}

/// Makes a short run under one fault and panics, naming the fault, unless the run ends safely.
/// Returns the ended process, and whether the run reached the fault.
fn run_once(fault: &str) -> (Ended, bool) {
    // Only the card `qube_servo3_usb` has options.
    let card =
        if fault.starts_with("hil_set_card") { "qube_servo3_usb" } else { "qube_servo2_usb" };
    let panel = Panel::new(&[("QUBE_TEST_HIL_FAULT", fault), ("QUBE_TEST_HIL_CARD", card)]);
    let arguments = ["run", "--policy", "classical", "--home", "hand", "--skip-check"];
    let address = format!("hil:{card}@0");
    let device = ["--device", &address, "--out", "runs", "--link-patience", "1"];
    let mut command = panel.command(&[&arguments[..], &device].concat());
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if begun.elapsed() > PATIENCE {
            let _ = child.kill();
            panic!("{fault}: the program hangs");
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let ended = Ended::of(child.wait_with_output().unwrap());
    let code = ended.code.unwrap_or(-1);
    assert!([0, 1, 2, 4].contains(&code), "{fault}: {ended:?}");
    assert!(!ended.told.contains("panicked"), "{fault}: {ended:?}");
    assert!(ended.told.matches("qube-hil doctor").count() <= 1, "{fault}: {ended:?}");
    // The library writes the state down when a fault begins, even at the first call.
    let state = panel.amplifier().unwrap_or_else(|| panic!("{fault}: nothing was called"));
    assert!(state.starts_with("enabled false\n"), "{fault}: {state} {ended:?}");
    let is_met = fault.split('+').all(|fault| is_met(&panel, fault));
    (ended, is_met)
}

/// Returns whether the call at which a fault begins was reached.
fn is_met(panel: &Panel, fault: &str) -> bool {
    let mut parts = fault.split(':');
    let function = parts.next().unwrap();
    let at = parts.nth(1).map_or(1, |at| at.parse().unwrap());
    panel.calls(function) >= at
}

/// Returns whether a fault stays once it has begun. No run can then succeed, unless the fault is of
/// a function in [`SPARED`].
fn lasts(fault: &str) -> bool {
    fault.split('+').all(|fault| fault.split(':').count() == 3)
}

/// Makes a run under each of these faults, [`AT_ONCE`] at a time; returns each fault with its ended
/// process.
fn run_all(faults: Vec<String>) -> Vec<(String, Ended)> {
    library();
    let left = Mutex::new(faults.into_iter());
    let ends = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| {
                loop {
                    let next = left.lock().unwrap().next();
                    let Some(fault) = next else { break };
                    let ended = run(&fault);
                    ends.lock().unwrap().push((fault, ended));
                }
            });
        }
    });
    ends.into_inner().unwrap()
}

#[test]
fn a_library_that_fails_for_good_leaves_the_amplifier_off() {
    must_end_safely(faults(false));
}

#[test]
#[ignore = "takes five minutes"]
fn a_library_that_fails_anywhere_in_any_way_leaves_the_amplifier_off() {
    must_end_safely(faults(true));
}

fn must_end_safely(faults: Vec<String>) {
    let number = faults.len();
    let ends = run_all(faults);
    assert_eq!(ends.len(), number);
    for (fault, ended) in &ends {
        let function = fault.split(':').next().unwrap();
        let is_survived = ended.code == Some(0);
        assert!(!(is_survived && lasts(fault)) || SPARED.contains(&function), "{fault}: {ended:?}");
        // Neither an error of the last 0 V nor the card that is closed after it is a motor that is
        // off.
        if fault == "hil_write_analog:error=13:150" {
            let is_told = ended.told.contains(&Fault::OffUnconfirmed.to_string());
            assert!(is_told, "{fault}: {ended:?}");
        }
        // A card that cannot even be opened is bad input.
        if fault.starts_with("hil_open:error") {
            assert_eq!(ended.code, Some(2), "{fault}: {ended:?}");
        }
        if fault.contains("hang=3600000") && ended.code == Some(4) {
            // While a call hangs, the cable or the pendulum may move the arm.
            let moved = "moved while the motor was off";
            let words = ["not returned from", "no valid sample", "watchdog", moved];
            let is_told = words.iter().any(|word| ended.told.contains(word))
                || ended.out.contains("watchdog")
                || ended.out.contains("no valid sample");
            assert!(is_told, "{function}: {ended:?}");
        }
    }
    let ended_so = |code| ends.iter().filter(|(_, ended)| ended.code == Some(code)).count();
    let [well, unfit, refused, faulted] = [0, 1, 2, 4].map(ended_so);
    println!(
        "{} runs: {well} completed, {unfit} failed, {refused} refused, {faulted} ended by a fault",
        ends.len()
    );
    assert!(refused > 0 && faulted > 0);
}

#[test]
fn a_count_that_jumps_by_a_counters_width_is_a_jump_like_any_other() {
    in_real_time(|| {
        for (fault, words) in
            [("hil_read:jump=65536:430", "arm"), ("hil_read:jump-alpha=16777216:430", "pendulum")]
        {
            let ended = run(fault);
            let told = format!("{}{}", ended.out, ended.told);
            assert_ne!(ended.code, Some(0), "{fault}: {ended:?}");
            assert!(told.contains(words) && told.contains("encoder"), "{fault}: {told}");
        }
    });
}

#[test]
fn a_second_interrupt_ends_the_program_with_the_amplifier_off() {
    in_real_time(|| {
        let panel = Panel::new(&[]);
        let arguments = ["run", "--policy", "classical", "--home", "hand", "--skip-check"];
        let device = ["--device", "hil", "--out", "runs"];
        let mut child = panel
            .command(&[&arguments[..], &device].concat())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let begun = Instant::now();
        while !panel.amplifier().is_some_and(|state| state.starts_with("enabled true\n")) {
            assert!(begun.elapsed() < PATIENCE, "the program never armed the card");
            std::thread::sleep(Duration::from_millis(5));
        }
        let process = rustix::process::Pid::from_child(&child);
        let mut interrupts = 0;
        while child.try_wait().unwrap().is_none() {
            assert!(begun.elapsed() < PATIENCE, "the program did not end");
            // Two interrupts count as one if the second comes before the first is handled.
            if interrupts < 200 {
                let _ = rustix::process::kill_process(process, rustix::process::Signal::INT);
                interrupts += 1;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(child.wait().unwrap().code(), Some(130));
        panel.must_be_off();
    });
}

#[test]
fn a_call_that_hangs_after_an_expired_watchdog_was_cleared_leaves_the_amplifier_off() {
    // A read that takes 120 ms lets the watchdog expire within homing. The library then refuses the
    // first call that disables the amplifier; the second such call, after the watchdog was cleared,
    // hangs.
    run("hil_read:hang=120:300:1+hil_write_digital:hang=3600000:4");
}
