//! Asking the operating system for real time. The one file of this room with `unsafe`.

use rustix::mm::{MlockAllFlags, mlockall};

/// Priority under SCHED_FIFO: above ordinary threads and below the kernel's own (which sit at 50
/// by default on PREEMPT_RT only for interrupts; 40 leaves those alone).
const FIFO_PRIORITY: i32 = 40;

/// What was granted. Each refusal is a sentence with its cure; none stops the program.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RealtimeReport {
    /// Why SCHED_FIFO was refused, if it was.
    pub scheduling: Option<String>,
    /// Why memory could not be locked, if it could not.
    pub memory: Option<String>,
}

/// Puts the calling thread under SCHED_FIFO and locks the process's memory, where that is allowed.
#[must_use]
pub fn enter_realtime() -> RealtimeReport {
    let scheduling = schedule_fifo().err().map(|error| {
        format!(
            "the control thread runs without real-time priority ({error}): ticks may be late. \
             Allow it with a line `@realtime - rtprio 50` in /etc/security/limits.conf and \
             membership in that group"
        )
    });
    let memory = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).err().map(|error| {
        format!(
            "memory could not be locked ({error}): a page fault may delay a tick. Allow it with a \
             line `@realtime - memlock unlimited` in /etc/security/limits.conf"
        )
    });
    RealtimeReport { scheduling, memory }
}

fn schedule_fifo() -> Result<(), std::io::Error> {
    let parameters = libc::sched_param { sched_priority: FIFO_PRIORITY };
    // SAFETY: `pthread_self` is always valid for the calling thread, and `parameters` outlives the call.
    let status = unsafe {
        libc::pthread_setschedparam(libc::pthread_self(), libc::SCHED_FIFO, &raw const parameters)
    };
    if status == 0 { Ok(()) } else { Err(std::io::Error::from_raw_os_error(status)) }
}
