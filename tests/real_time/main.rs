//! Tests that wait by the wall clock: programs at a real pty or a terminal, an emulated Qube that
//! is served while time passes, and the vendor's library with a plant behind it.
//!
//! Most of them only wait, so two tests at once take the time of one; a few in virtual time stand
//! beside tests of the same subject. Tests that compute much are in `tests/virtual_time`, because
//! here they would make the others late. Tests that need much memory are there, too, because an
//! emulated Qube on a pty locks the memory of its process.

mod busy_computer;
mod commands_check;
mod commands_run_ends;
mod commands_screen;
mod commands_space_bar;
mod commands_unconfirmed_off;
mod device_hil_faults;
mod device_hil_panel;
mod device_pty;
#[cfg(feature = "live")]
mod live_run;
mod panel;
mod preflight_conformance;
mod preflight_power;
mod program;
mod recording_killed;
mod rig_slow_bridge;
#[path = "../shared/mod.rs"]
mod shared;
