//! Repeats a test that runs in real time, if it fails on a computer that did not keep up.

use std::any::Any;
use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Words with which the program reports that the computer was too late.
pub const TOO_LATE: &str = "keep this computer busy";

/// Largest number of repetitions of a test.
const AGAIN: u32 = 6;

/// Lateness of a thread from which on the computer counts as stalled: longer than a control period,
/// and longer than the scheduler lets a ready thread wait on a computer that keeps up.
pub const STANDS_STILL: Duration = Duration::from_millis(15);

/// Interval at which a thread that measures stalls wakes.
const NAP: Duration = Duration::from_millis(2);

/// Time without a stall after which the computer counts as calm.
const CALM: Duration = Duration::from_secs(2);

/// Largest number of intervals of [`CALM`] to wait for before a repetition.
const CALMS: u32 = 15;

/// Runs a test whose emulated Qube is served in real time. If it fails and either the computer
/// stalled meanwhile or the program reports a busy computer, the test is repeated; any other
/// failure is final, and so is the failure of the last repetition.
pub fn in_real_time(test: impl Fn()) {
    for again in 1..=AGAIN {
        let (ended, stood) = witnessed(&test);
        let Err(panic) = ended else { return };
        let says_too_late = text(panic.as_ref()).contains(TOO_LATE);
        if stood < STANDS_STILL && !says_too_late {
            resume_unwind(panic);
        }
        let says = if says_too_late { ", and the program calls it too busy" } else { "" };
        // Bypasses the test harness, which hides the output of a test that passes.
        let _ = writeln!(
            std::io::stderr(),
            "begun again, {again} of at most {AGAIN} times: \
             the computer stood still for {} ms{says}",
            stood.as_millis()
        );
        wait_for_calm();
    }
    test();
}

/// Waits until the computer keeps up, at most half a minute: stalls come in bursts.
pub fn wait_for_calm() {
    for _ in 0..CALMS {
        let (_, stood) = witnessed(&|| std::thread::sleep(CALM));
        if stood < STANDS_STILL {
            return;
        }
    }
}

/// Runs a test; returns its result, and the longest stall of a processor meanwhile.
pub fn witnessed(test: &impl Fn()) -> (std::thread::Result<()>, Duration) {
    let is_over = AtomicBool::new(false);
    let processors = sched_getaffinity(None).unwrap_or_else(|_| CpuSet::new());
    std::thread::scope(|scope| {
        let witnesses: Vec<_> = (0..CpuSet::MAX_CPU)
            .filter(|processor| processors.is_set(*processor))
            .map(|processor| {
                scope.spawn({
                    let is_over = &is_over;
                    move || longest_stall(processor, is_over)
                })
            })
            .collect();
        let ended = catch_unwind(AssertUnwindSafe(test));
        is_over.store(true, Ordering::Relaxed);
        let stalls = witnesses.into_iter().map(|witness| witness.join().unwrap_or_default());
        (ended, stalls.max().unwrap_or_default())
    })
}

/// Largest lateness of a thread on this processor until the test is over.
fn longest_stall(processor: usize, is_over: &AtomicBool) -> Duration {
    let mut here = CpuSet::new();
    here.set(processor);
    let _ = sched_setaffinity(None, &here);
    let mut longest = Duration::ZERO;
    while !is_over.load(Ordering::Relaxed) {
        let asleep = Instant::now();
        std::thread::sleep(NAP);
        longest = longest.max(asleep.elapsed().saturating_sub(NAP));
    }
    longest
}

/// The message of a panic.
fn text(panic: &(dyn Any + Send)) -> &str {
    let owned = panic.downcast_ref::<String>().map(String::as_str);
    owned.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or_default()
}
