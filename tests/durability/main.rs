//! Tests that nothing is lost: the wire fails at every operation, sessions survive seeded schedules
//! of faults, files are cut at every byte, processes are killed at random instants, and disks fail.
//!
//! Everything except the processes runs in virtual time. The numbers here are small;
//! `scripts/durability` sets the environment to the large numbers.

#[path = "../real_time/busy_computer.rs"]
mod busy_computer;
mod bystanders;
mod cuts;
mod fault_port;
mod jobs;
mod processes;
mod schedules;
#[path = "../shared/mod.rs"]
mod shared;
mod simulated_disk;
mod sweep;
mod watched_wire;
mod world;

/// A number from the environment, or the small default.
fn count_from(variable: &str, small: u64) -> u64 {
    match std::env::var(variable) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{variable}={text} is no number")),
        Err(_) => small,
    }
}
