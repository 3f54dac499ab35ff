//! Tests in real time, on a computer that does not always keep up.

use std::any::Any;
use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// What the program says where the computer was too late for a Qube.
const TOO_LATE: &str = "keeps this computer busy";

/// How often a test is begun again.
const AGAIN: u32 = 6;

/// A computer that wakes a thread so much later than it asked for stands still: longer than a control
/// period, and than what the system's scheduler takes between threads that are ready.
const STANDS_STILL: Duration = Duration::from_millis(15);

/// How long the witness sleeps at a time.
const NAP: Duration = Duration::from_millis(2);

/// A computer that has kept up for so long may go on doing so.
const CALM: Duration = Duration::from_secs(2);

/// How often a calm of that length is waited for before a test begins again.
const CALMS: u32 = 15;

/// The Qubes of a test are served in real time: one test after the other.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// Runs a test whose emulated Qube is served in real time. Where it fails and the computer stood still
/// meanwhile, or the program says that the computer is too busy, it is begun again; what fails on a
/// computer that kept up fails at once.
pub fn in_real_time(test: impl Fn()) {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    for again in 1..=AGAIN {
        let (ended, stood) = witnessed(&test);
        let Err(panic) = ended else { return };
        let says_too_late = text(panic.as_ref()).contains(TOO_LATE);
        if stood < STANDS_STILL && !says_too_late {
            resume_unwind(panic);
        }
        let says = if says_too_late { ", and the program calls it too busy" } else { "" };
        // Past the test harness, which shows nothing of a test that passes.
        let _ = writeln!(
            std::io::stderr(),
            "begun again, {again} of at most {AGAIN} times: the computer stood still for {} ms{says}",
            stood.as_millis()
        );
        wait_for_calm();
    }
    test();
}

/// Waits until the computer keeps up, half a minute at most: stalls come in bursts.
fn wait_for_calm() {
    for _ in 0..CALMS {
        let (_, stood) = witnessed(&|| std::thread::sleep(CALM));
        if stood < STANDS_STILL {
            return;
        }
    }
}

/// How a test ended, and the longest time for which a processor stood still meanwhile.
fn witnessed(test: &impl Fn()) -> (std::thread::Result<()>, Duration) {
    let is_over = AtomicBool::new(false);
    let processors = sched_getaffinity(None).unwrap_or_else(|_| CpuSet::new());
    std::thread::scope(|scope| {
        let witnesses: Vec<_> = (0..CpuSet::MAX_CPU)
            .filter(|processor| processors.is_set(*processor))
            .map(|processor| {
                scope.spawn({
                    let is_over = &is_over;
                    move || longest_stand(processor, is_over)
                })
            })
            .collect();
        let ended = catch_unwind(AssertUnwindSafe(test));
        is_over.store(true, Ordering::Relaxed);
        let stands = witnesses.into_iter().map(|witness| witness.join().unwrap_or_default());
        (ended, stands.max().unwrap_or_default())
    })
}

/// How much later than asked for a thread on this processor wakes, at most, until the test is over.
fn longest_stand(processor: usize, is_over: &AtomicBool) -> Duration {
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

/// What a panic says.
fn text(panic: &(dyn Any + Send)) -> &str {
    let owned = panic.downcast_ref::<String>().map(String::as_str);
    owned.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or_default()
}
