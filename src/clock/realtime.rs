//! Real-time scheduling by the operating system. No other file of this room contains `unsafe`.

use std::num::NonZeroU64;
use std::path::Path;

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit};
use rustix::thread::{CapabilitySet, capabilities, set_current_timer_slack};

use super::{AwakeProcessors, CPU_DMA_LATENCY};

/// Priority under SCHED_FIFO: above ordinary threads and below the kernel's interrupt threads
/// (priority 50 by default on PREEMPT_RT).
const FIFO_PRIORITY: i32 = 40;

/// Timer slack of the thread, ns: the delay that the kernel may add to a wake-up of ordinary
/// priority in order to wake several threads at once (default 50 us). Under SCHED_FIFO the kernel
/// adds no delay.
const TIMER_SLACK_NS: NonZeroU64 = NonZeroU64::MIN;

/// The real-time rights that the operating system refused, each as a message with its remedy;
/// `None` for a right that it granted. The program also runs without them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RealtimeRefusals {
    /// Reason why SCHED_FIFO was refused.
    pub scheduling: Option<String>,
    /// Reason why memory could not be locked.
    pub memory: Option<String>,
    /// Reason why the processors cannot be kept awake.
    pub awake: Option<String>,
    /// Reason why timers are not exact at ordinary priority.
    pub timer_slack: Option<String>,
}

impl RealtimeRefusals {
    /// Returns the refusals, most serious first.
    pub fn refusals(&self) -> impl Iterator<Item = &str> {
        [&self.scheduling, &self.memory, &self.awake, &self.timer_slack]
            .into_iter()
            .filter_map(|refusal| refusal.as_deref())
    }
}

/// Puts the calling thread under SCHED_FIFO, locks the process's memory and requests exact timers,
/// where permitted. It only tests whether the processors can be kept awake;
/// [`Clock::stay_awake`](super::Clock::stay_awake) keeps them awake while a device is driven.
#[must_use]
pub fn enter_realtime() -> RealtimeRefusals {
    let scheduling = schedule_fifo().err().map(|error| {
        format!(
            "the control thread runs without real-time priority ({error}): ticks may be late. \
             Allow it with a line `@realtime - rtprio 50` in /etc/security/limits.conf and \
             membership in that group"
        )
    });
    let memory = lock_memory().err().map(|error| {
        format!(
            "memory could not be locked ({error}): a page fault may delay a tick. Allow it with a \
             line `@realtime - memlock unlimited` in /etc/security/limits.conf and membership in \
             that group"
        )
    });
    let timer_slack = set_current_timer_slack(Some(TIMER_SLACK_NS)).err().map(|error| {
        format!(
            "the kernel may wake the control thread 0.05 ms late ({error}). With real-time \
             priority it adds no delay"
        )
    });
    RealtimeRefusals {
        scheduling,
        memory,
        awake: awake_refusal(Path::new(CPU_DMA_LATENCY)),
        timer_slack,
    }
}

/// Returns the reason why the processors cannot be kept awake through this file; `None` if they
/// can.
fn awake_refusal(file: &Path) -> Option<String> {
    let error = AwakeProcessors::hold(file).err()?;
    Some(format!(
        "the processors may sleep between two ticks ({}: {error}): ticks may be 0.1 ms late. Allow \
         the group realtime to write that file with `sudo scripts/install` and membership in that \
         group",
        file.display()
    ))
}

/// Locks the memory that the process has now and will have.
fn lock_memory() -> Result<(), std::io::Error> {
    let may_exceed = capabilities(None)
        .is_ok_and(|capabilities| capabilities.effective.contains(CapabilitySet::IPC_LOCK));
    check_lock_limit(getrlimit(Resource::Memlock).current, may_exceed)?;
    Ok(mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE)?)
}

/// Refuses to lock memory under a limit that the process may not exceed. All memory that the
/// process allocates later would count towards the limit, and the first allocation beyond it, such
/// as a training's, would fail and end the program.
fn check_lock_limit(limit_bytes: Option<u64>, may_exceed: bool) -> Result<(), std::io::Error> {
    match limit_bytes {
        Some(limit_bytes) if !may_exceed => {
            let reason = format!("at most {} kB may be locked", limit_bytes / 1024);
            Err(std::io::Error::other(reason))
        }
        _ => Ok(()),
    }
}

/// Puts the calling thread under SCHED_FIFO with [`FIFO_PRIORITY`].
fn schedule_fifo() -> Result<(), std::io::Error> {
    let parameters = libc::sched_param { sched_priority: FIFO_PRIORITY };
    // SAFETY: `pthread_self` is always valid for the calling thread, and `parameters` outlives the
    // call.
    let status = unsafe {
        libc::pthread_setschedparam(libc::pthread_self(), libc::SCHED_FIFO, &raw const parameters)
    };
    if status == 0 { Ok(()) } else { Err(std::io::Error::from_raw_os_error(status)) }
}

#[cfg(test)]
mod tests {
    use rustix::thread::current_timer_slack;

    use super::*;

    #[test]
    fn a_processor_that_may_sleep_is_named_with_its_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("cpu_dma_latency");
        let message = awake_refusal(&file).unwrap();
        assert!(
            message.contains("cpu_dma_latency") && message.contains("sudo scripts/install"),
            "{message}"
        );
        std::fs::write(&file, "").unwrap();
        assert_eq!(awake_refusal(&file), None);
    }

    #[test]
    fn memory_is_locked_only_if_no_limit_applies() {
        for (limit_bytes, may_exceed) in [(None, false), (None, true), (Some(8 << 20), true)] {
            assert!(check_lock_limit(limit_bytes, may_exceed).is_ok());
        }
        let refusal = check_lock_limit(Some(512 << 20), false).unwrap_err().to_string();
        assert_eq!(refusal, "at most 524288 kB may be locked");
    }

    #[test]
    fn the_thread_gets_exact_timers() {
        let slack_ns = std::thread::spawn(|| {
            let report = enter_realtime();
            // Under SCHED_FIFO the kernel reports no slack at all.
            (report.timer_slack, current_timer_slack().unwrap())
        });
        let (refusal, slack_ns) = slack_ns.join().unwrap();
        assert!(refusal.is_none() && slack_ns <= 1, "{refusal:?}, {slack_ns} ns");
    }
}
