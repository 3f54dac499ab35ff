//! Tests the firmware binary, run by simavr on a real pty, with a Qube on its SPI.
//!
//! `make` builds the binary in `target/tmp/firmware`. The tests need the Debian packages gcc-avr,
//! avr-libc, libsimavr-dev and libelf-dev. Without them one line reports that the tests are
//! skipped, or each test fails if they are required (`CI` or `QUBE_HIL_REQUIRE_FIRMWARE` is set).

mod acting;
mod board_clock;
#[path = "../real_time/busy_computer.rs"]
#[allow(dead_code, reason = "these tests repeat an attempt by rules of their own")]
mod busy_computer;
mod check;
mod conformance;
mod faults;
mod host;
mod latency;
mod power;
mod qube;
#[path = "../shared/mod.rs"]
mod shared;
mod simulated_board;
mod stop_switch;
mod swing_up;
mod toolchain;
