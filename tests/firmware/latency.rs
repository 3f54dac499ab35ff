//! Measures the latency of the simulated board for `firmware-protocol/firmware/README.md`:
//! `cargo test --release --test firmware latency -- --ignored --nocapture`.

use std::time::{Duration, Instant};

use qube_hil::clock::enter_realtime;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::host::Host;
use crate::qube::Qube;
use crate::shared::command_in;
use crate::simulated_board::SimulatedBoard;
use crate::toolchain::{Chip, toolchain};

const SAMPLES: usize = 2000;
const ROLLOUTS: &str = "5";

fn percentiles(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    let at =
        |fraction: f64| values[((fraction * values.len() as f64) as usize).min(values.len() - 1)];
    format!("p50 {:.0}  p99 {:.0}  p99.9 {:.0} us", at(0.5), at(0.99), at(0.999))
}

#[test]
#[ignore = "a measurement of two minutes"]
fn latency_on_the_firmware() {
    let Some(toolchain) = toolchain() else { return };
    let directory = tempfile::tempdir().unwrap();
    let board = SimulatedBoard::start(toolchain, Chip::Atmega328p, Qube::new(0));
    let output = command_in(directory.path())
        .args(["run", "--policy", "classical", "--rollouts", ROLLOUTS, "--device", board.port()])
        .args(["--out", directory.path().to_str().unwrap()])
        .output()
        .expect("the program runs");
    println!(
        "{}{}\n{:.1} s simulated with {:.0} % of a core, {} us given up",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
        board.time_us() as f64 * 1e-6,
        100.0 * board.processor_s() / (board.time_us() as f64 * 1e-6),
        board.given_up_us()
    );
    drop(board);

    let board = SimulatedBoard::start(toolchain, Chip::Atmega328p, Qube::new(0));
    let mut host = Host::greet(board);
    let mut round_trips_us = Vec::new();
    let mut random = ChaCha8Rng::seed_from_u64(0);
    // This is the last measurement, because the thread keeps its priority. Without real-time rights
    // the tail is longer.
    let _ = enter_realtime();
    while round_trips_us.len() < SAMPLES {
        // The requests come at all phases of the device's sampling timer.
        std::thread::sleep(Duration::from_micros(random.random_range(5_000..9_000)));
        let requested = Instant::now();
        if host.sample().is_ok() {
            round_trips_us.push(requested.elapsed().as_secs_f64() * 1e6);
        }
    }
    println!("Sample to SampleReply, {SAMPLES} times: {}", percentiles(round_trips_us));
}
