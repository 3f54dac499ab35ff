//! Nothing is lost: the wire fails at every operation, sessions live through seeded schedules of
//! faults, files are cut at every byte, processes are killed at any instant, disks fail.
//!
//! Everything but the processes runs in virtual time. The counts here are small; `scripts/durability`
//! sets the environment to the large ones.

mod bystanders;
mod cuts;
mod fault_port;
mod processes;
#[path = "../real_time/mod.rs"]
mod real_time;
mod schedules;
mod simulated_disk;
mod sweep;
mod watched_wire;
mod world;

/// A count from the environment, or the small one for every day.
fn count_from(variable: &str, small: u64) -> u64 {
    match std::env::var(variable) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{variable}={text} is no number")),
        Err(_) => small,
    }
}
