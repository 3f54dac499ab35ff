use std::sync::atomic::{AtomicBool, Ordering};

use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, DeviceError, Identity};

const MS: Nanoseconds = 1_000_000;

/// Pauses between attempts to reach a silent device, ns; further attempts repeat the last pause.
const PAUSES_NS: [Nanoseconds; 5] = [100 * MS, 200 * MS, 500 * MS, 1000 * MS, 2000 * MS];

/// Interval at which a pause checks for a request to stop, ns.
const STOP_POLL_NS: Nanoseconds = 50 * MS;

/// Timing of the hellos to a device that has fallen silent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HelloRetries {
    /// Pause before the first hello, ns. A delayed link may stay delayed for seconds.
    pub pause_ns: Nanoseconds,
    /// Time after that pause for which hellos to a silent device are repeated, ns.
    pub limit_ns: Nanoseconds,
}

/// Sends hellos until the device answers or the time of `retries` is over, and reopens the port
/// before each further attempt.
///
/// # Errors
/// The error of the last hello. An error that [waiting does not
/// cure](DeviceError::is_cured_by_waiting) ends the attempts at once, and so does a request to
/// stop.
pub(super) fn greet_until_answered(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    retries: HelloRetries,
) -> Result<Identity, DeviceError> {
    let end_ns = clock.now_ns().saturating_add(retries.pause_ns).saturating_add(retries.limit_ns);
    pause(clock, stop, retries.pause_ns);
    let mut pauses = PAUSES_NS.into_iter().chain(std::iter::repeat(PAUSES_NS[4]));
    loop {
        match device.hello() {
            Ok(identity) => return Ok(identity),
            Err(error) => {
                let is_over = clock.now_ns() >= end_ns || stop.load(Ordering::Relaxed);
                if is_over || !error.is_cured_by_waiting() {
                    return Err(error);
                }
            }
        }
        pause(clock, stop, pauses.next().unwrap_or(PAUSES_NS[4]));
        // If the port has not come back, the next hello reports it.
        let _ = device.reopen();
    }
}

fn pause(clock: &dyn Clock, stop: &AtomicBool, pause_ns: Nanoseconds) {
    let end_ns = clock.now_ns() + pause_ns;
    while clock.now_ns() < end_ns && !stop.load(Ordering::Relaxed) {
        clock.sleep_until(end_ns.min(clock.now_ns() + STOP_POLL_NS));
    }
}

#[cfg(test)]
mod tests {
    use super::super::plant_device::PlantDevice;
    use super::*;
    use crate::qube::State;

    /// Times at which a device that never answers received hellos, s.
    fn hellos(retries: HelloRetries, stop: &AtomicBool) -> Vec<f64> {
        let mut device = PlantDevice::new(State::default());
        let clock = device.clock.clone();
        device.deaf_until_ns = Nanoseconds::MAX;
        greet_until_answered(&mut device, &clock, stop, retries).unwrap_err();
        device.hellos_ns.iter().map(|time_ns| *time_ns as f64 * 1e-9).collect()
    }

    #[test]
    fn a_lost_link_is_tried_again_at_growing_intervals_for_a_set_time() {
        let stop = AtomicBool::new(false);
        let tries = hellos(HelloRetries { pause_ns: 0, limit_ns: 30_000 * MS }, &stop);
        let first: Vec<f64> =
            tries[..7].iter().map(|time_s| (time_s * 10.0).round() / 10.0).collect();
        assert_eq!(first, [0.0, 0.1, 0.3, 0.8, 1.8, 3.8, 5.8]);
        assert!(tries.iter().all(|time_s| *time_s < 32.1), "{tries:?}");
        assert!(tries.last() > Some(&28.0), "{tries:?}");
        assert_eq!(hellos(HelloRetries::default(), &stop).len(), 1);
        stop.store(true, Ordering::Relaxed);
        assert_eq!(hellos(HelloRetries { pause_ns: 0, limit_ns: 30_000 * MS }, &stop).len(), 1);
    }

    #[test]
    fn a_device_that_comes_back_is_found() {
        let mut device = PlantDevice::new(State::default());
        let clock = device.clock.clone();
        device.deaf_until_ns = 5_000 * MS;
        let retries = HelloRetries { pause_ns: 0, limit_ns: 30_000 * MS };
        greet_until_answered(&mut device, &clock, &AtomicBool::new(false), retries).unwrap();
        assert!(clock.now_ns() < 8_000 * MS);
    }
}
