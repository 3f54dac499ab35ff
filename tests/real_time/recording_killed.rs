//! Tests that a process that is killed with SIGKILL while it records has every tick that is older
//! than 250 ms in its file.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use qube_hil::clock::{Clock, MonotonicClock};
use qube_hil::estimation::Calibration;
use qube_hil::qube::{CONTROL_PERIOD_NS, Measurement, RewardWeights};
use qube_hil::recording::{Completeness, FORMAT_VERSION, Recorder, read};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::SafetyBox;
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{RolloutHeader, TickRecord, TickSettings};

use crate::busy_computer::in_real_time;

const CHILD: &str = "QUBE_HIL_TEST_RECORD_TO";
const PROMISE_NS: u64 = 250_000_000;
const TICKS: usize = 47;

/// Fewest ticks before a kill: the first five of them are then at least 250 ms old, and promised.
const FEWEST_TICKS: usize = 30;

fn header() -> RolloutHeader {
    RolloutHeader {
        format: FORMAT_VERSION,
        session: "killed".to_owned(),
        candidate: None,
        rollout: 0,
        attempt: 0,
        psi: BTreeMap::new(),
        seed: 0,
        started_unix_ns: Some(1_700_000_000_000_000_000),
        program_version: "0".to_owned(),
        git_revision: "unknown".to_owned(),
        device: Default::default(),
        preflight: Default::default(),
        motor_heat: None,
        hard_stop_accepted: false,
        policy: "none".to_owned(),
        settings: TickSettings {
            calibration: Calibration::IDENTITY,
            safety_box: SafetyBox::THESIS,
            start_theta_rad: 0.0,
            ..RolloutPlan::single("test", "test").header().settings
        },
        reward: RewardWeights::THESIS,
    }
}

/// Records ticks in the process that is killed; does nothing without the variable [`CHILD`].
#[test]
fn the_killed_process_records_ticks() {
    let Some(path) = std::env::var_os(CHILD) else { return };
    let (mut producer, consumer) = rtrb::RingBuffer::new(4096);
    let _recorder =
        Recorder::start(&MachineDisk, Path::new(&path), header(), b"policy", consumer, Vec::new())
            .unwrap();
    let clock = MonotonicClock;
    let mut deadline_ns = clock.now_ns();
    // The ticks come at 100 Hz and then stop, so that the last ones wait in a block that is not
    // full.
    for number in 0..TICKS as u32 {
        clock.sleep_until(deadline_ns);
        let record = TickRecord {
            tick: number,
            deadline_ns: clock.now_ns(),
            measurement: Some(Measurement::default()),
            ..TickRecord::default()
        };
        producer.push(record).unwrap();
        println!("tick {number} {}", record.deadline_ns);
        std::io::stdout().flush().unwrap();
        deadline_ns += CONTROL_PERIOD_NS;
    }
    std::thread::sleep(Duration::from_secs(60));
}

/// Number and time, ns, of a tick that the child has given the recorder; `None` for other lines.
fn tick(line: String) -> Option<(u32, u64)> {
    let (number, time_ns) = line.split_once("tick ")?.1.split_once(' ')?;
    Some((number.parse().ok()?, time_ns.parse().ok()?))
}

/// Kills the child after this many ticks and a pause, and checks that its file has all promised
/// ticks. No program can keep the promise on a computer that keeps the recorder from running for
/// 0.1 s, so a kill on a computer that stalled is repeated.
fn nothing_is_missing(ticks: usize, pause: Duration) {
    in_real_time(|| kill(ticks, pause));
}

fn kill(ticks: usize, pause: Duration) {
    // In memory if possible: a disk that other programs keep busy delays the recorder's writes,
    // which shows as no stall of a processor.
    let directory = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
    let path = directory.path().join("killed.mcap");
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "recording_killed::the_killed_process_records_ticks", "--nocapture"])
        .env(CHILD, &path)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut pushed =
        lines.by_ref().map_while(Result::ok).filter_map(tick).take(ticks).collect::<Vec<_>>();
    std::thread::sleep(pause);
    let killed_ns = MonotonicClock.now_ns();
    child.kill().unwrap();
    child.wait().unwrap();
    pushed.extend(lines.map_while(Result::ok).filter_map(tick));

    let recording = read(&path).unwrap();
    assert!(matches!(recording.completeness, Completeness::CutOff { .. }));
    assert_eq!(recording.policy, b"policy");
    assert!(
        !recording.lacks_ticks(),
        "the recording does not begin with its first tick, or has gaps"
    );
    let found = recording.ticks.len() as u32;
    let promised = pushed.iter().filter(|(_, time_ns)| time_ns + PROMISE_NS <= killed_ns);
    let promised: Vec<u32> = promised.map(|(number, _)| *number).collect();
    assert!(!promised.is_empty(), "no tick was old enough when the recorder was killed");
    let missing: Vec<_> = promised.iter().filter(|number| **number >= found).collect();
    assert!(missing.is_empty(), "ticks older than 250 ms are missing: {missing:?}");
}

#[test]
fn killed_in_the_middle_all_but_the_last_quarter_second_is_readable() {
    nothing_is_missing(45, Duration::ZERO);
}

/// Kills after different numbers of ticks: four, or as many as `scripts/durability recorder-kills`
/// requests. The first one shows whether a recorder writes every 0.35 s or less often; the others
/// come at other times of such an interval.
#[test]
fn killed_again_and_again_all_but_the_last_quarter_second_is_readable() {
    let kills = std::env::var("QUBE_HIL_RECORDER_KILLS").unwrap_or_else(|_| "4".to_owned());
    let kills: usize = kills.parse().unwrap();
    for kill in 0..kills {
        let pause = Duration::from_millis(37 * (kill as u64 % 5));
        nothing_is_missing(FEWEST_TICKS + kill * 5 % (TICKS - FEWEST_TICKS), pause);
    }
    println!("{kills} kills of a recorder");
}

/// The pause is hardly longer than the promised time, so that the last ticks must have been written
/// because of their age.
#[test]
fn killed_while_no_ticks_come_the_open_block_is_readable() {
    nothing_is_missing(TICKS, Duration::from_millis(260));
}
