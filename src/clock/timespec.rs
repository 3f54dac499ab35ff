use rustix::time::Timespec;

use super::Nanoseconds;

const NS_PER_S: Nanoseconds = 1_000_000_000;

/// Converts a time or a duration to the type of the operating system's calls.
pub(crate) fn timespec(time_ns: Nanoseconds) -> Timespec {
    Timespec { tv_sec: (time_ns / NS_PER_S) as i64, tv_nsec: (time_ns % NS_PER_S) as _ }
}

/// Converts to nanoseconds a time that the operating system returned.
pub(super) fn nanoseconds(time: &Timespec) -> Nanoseconds {
    time.tv_sec as u64 * NS_PER_S + time.tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_split_into_whole_seconds_and_nanoseconds() {
        let time = timespec(3_000_000_007);
        assert_eq!((time.tv_sec, time.tv_nsec), (3, 7));
        assert_eq!(nanoseconds(&time), 3_000_000_007);
    }
}
