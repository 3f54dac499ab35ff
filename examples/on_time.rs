//! Wakes up 100 times a second like the control thread, with or without each of the measures for
//! punctuality, and prints percentiles of the lateness in microseconds as one JSON object.
//!
//! `scripts/on-time` runs it beside cyclictest.

use std::num::NonZeroU64;
use std::time::Duration;

use clap::Parser;
use qube_hil::clock::{Clock, PunctualClock, enter_realtime};
use qube_hil::control::LatencyHistogram;
use qube_hil::qube::CONTROL_PERIOD_NS;
use rustix::thread::{
    CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity, set_current_timer_slack,
};

#[derive(Parser)]
struct Arguments {
    /// Duration of the measurement, s
    #[arg(long, default_value_t = 10)]
    seconds: u64,
    /// Run without SCHED_FIFO and locked memory
    #[arg(long)]
    ordinary: bool,
    /// Keep the processors awake
    #[arg(long)]
    awake: bool,
    /// Stay on the processor where it starts
    #[arg(long)]
    pinned: bool,
    /// Use the kernel's default timer slack of 50 us instead of 1 ns
    #[arg(long)]
    slack: bool,
    /// Duration of the spin before each deadline, us, at most 100
    #[arg(long, default_value_t = 0)]
    spin_us: u64,
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    if !arguments.ordinary {
        let refused: Vec<_> = enter_realtime().refusals().map(str::to_owned).collect();
        anyhow::ensure!(refused.is_empty(), "{}", refused.join("\n"));
    }
    let slack_ns = if arguments.slack { 50_000 } else { 1 };
    set_current_timer_slack(NonZeroU64::new(slack_ns))?;
    if arguments.pinned {
        let here = sched_getcpu();
        let mut one = CpuSet::new();
        one.set(here);
        anyhow::ensure!(sched_getaffinity(None)?.is_set(here));
        sched_setaffinity(None, &one)?;
    }
    let clock = PunctualClock::new().with_spin_ns(arguments.spin_us * 1000);
    let _awake = arguments.awake.then(|| clock.stay_awake());

    let mut lateness = LatencyHistogram::new();
    let start_ns = clock.now_ns();
    let mut deadline_ns = start_ns;
    while deadline_ns - start_ns < Duration::from_secs(arguments.seconds).as_nanos() as u64 {
        deadline_ns += CONTROL_PERIOD_NS;
        clock.sleep_until(deadline_ns);
        lateness.record(clock.now_ns().saturating_sub(deadline_ns));
    }
    println!("{}", serde_json::to_string(&lateness.summary())?);
    Ok(())
}
