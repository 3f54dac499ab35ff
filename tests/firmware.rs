//! Tests the firmware binary, run by simavr on a real pty, with a Qube on its SPI.
//!
//! `make` builds it into `target/firmware`. It needs the Debian packages gcc-avr, avr-libc,
//! libsimavr-dev and libelf-dev. Without them each test reports that it is skipped, or fails if
//! they are required (`CI` or `QUBE_HIL_REQUIRE_FIRMWARE` is set).

#[path = "firmware/acting.rs"]
mod acting;
#[path = "firmware/board_clock.rs"]
mod board_clock;
#[path = "firmware/check.rs"]
mod check;
#[path = "firmware/conformance.rs"]
mod conformance;
#[path = "firmware/faults.rs"]
mod faults;
#[path = "firmware/host.rs"]
mod host;
#[path = "firmware/latency.rs"]
mod latency;
#[path = "firmware/power.rs"]
mod power;
#[path = "firmware/qube.rs"]
mod qube;
#[path = "firmware/simulated_board.rs"]
mod simulated_board;
#[path = "firmware/stop_switch.rs"]
mod stop_switch;
#[path = "firmware/swing_up.rs"]
mod swing_up;
#[path = "firmware/toolchain.rs"]
mod toolchain;
