//! Knowledge that the control thread keeps from one motion to the next: the motor's heat, and the
//! counts at which arm and pendulum came to rest.

use std::sync::atomic::{AtomicBool, Ordering};

use super::{ControlError, DeviceLoss, Moved, RestWatch, RestingCounts, SAMPLE_TIMEOUT_NS};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, DeviceError, LinkFault};
use crate::qube::{CONTROL_PERIOD_NS, Encoders, Measurement};
use crate::safety::MotorHeat;
use crate::telemetry::TickSettings;

/// Interval at which a cooling pause checks for a request to stop, ns.
const COOLING_STEP_NS: Nanoseconds = 100_000_000;

/// Time that arm and pendulum may take to come to rest with the amplifier off, ns. If they do not,
/// the arm is homed before the next rollout.
const REST_TIME_NS: Nanoseconds = 15_000_000_000;

/// Pause between two motions, ns, below which an arm that has moved meanwhile was not at rest at
/// the beginning of the pause.
const SHORT_PAUSE_NS: Nanoseconds = 5_000_000_000;

/// The motor's heat between motions.
#[derive(Debug, Default)]
pub(super) struct MotorCooling {
    pub heat: MotorHeat,
    /// Time up to which `heat` is computed and since which the motor has had no current, ns; `None`
    /// before the first motion.
    off_since_ns: Option<Nanoseconds>,
}

impl MotorCooling {
    /// A motor with this heat whose current ends now.
    pub fn off_from_now(heat: MotorHeat, clock: &dyn Clock) -> Self {
        Self { heat, off_since_ns: Some(clock.now_ns()) }
    }

    /// Notes that the current ends now.
    pub fn switched_off(&mut self, clock: &dyn Clock) {
        self.off_since_ns = Some(clock.now_ns());
    }

    /// Cools the motor for the time without current since the last update.
    pub fn cool(&mut self, clock: &dyn Clock) {
        if let Some(off_since_ns) = &mut self.off_since_ns {
            let now_ns = clock.now_ns();
            let off_ns = now_ns.saturating_sub(*off_since_ns);
            self.heat = self.heat.cooled(off_ns as f64 * 1e-9);
            *off_since_ns = now_ns;
        }
    }

    /// Waits with the amplifier off until the motor is cool enough for the next motion or `stop` is
    /// set.
    pub fn cool_down(&mut self, clock: &dyn Clock, stop: &AtomicBool) {
        self.cool(clock);
        let cooling_ns = (self.heat.cooling_s() * 1e9) as Nanoseconds;
        let end_ns = clock.now_ns().saturating_add(cooling_ns);
        while clock.now_ns() < end_ns && !stop.load(Ordering::Relaxed) {
            clock.sleep_until(end_ns.min(clock.now_ns() + COOLING_STEP_NS));
            self.cool(clock);
        }
    }
}

/// The state that ends a watch of arm and pendulum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WaitsFor {
    /// Both are at rest.
    Rest,
    /// Both are at rest, and the arm is [still](RestWatch::is_still).
    Stillness,
}

/// Knowledge about the encoder counts between motions.
#[derive(Debug)]
pub(super) struct RestMonitor {
    /// Name of the port for errors.
    pub port: String,
    /// Counts at which arm and pendulum came to rest after the last motion, or the reason why they
    /// are not known.
    pub left_at: Result<RestingCounts, Moved>,
    /// Encoders of the plant that was homed.
    pub encoders: Encoders,
    /// Time at which `left_at` was determined, ns.
    pub left_ns: Nanoseconds,
    /// The state that ends the watch after each motion. It becomes [`WaitsFor::Stillness`] for as
    /// long as the device stays open once the arm has moved within a pause shorter than
    /// [`SHORT_PAUSE_NS`], because a cable may pull the arm away after each motion. In a longer
    /// pause, such as a training, an arm that was at rest may creep away; homing the arm again then
    /// costs less time than waiting after each motion.
    pub waits_for: WaitsFor,
}

impl Default for RestMonitor {
    fn default() -> Self {
        let (port, encoders) = (String::new(), Encoders::default());
        Self { port, left_at: Err(Moved::Unseen), encoders, left_ns: 0, waits_for: WaitsFor::Rest }
    }
}

impl RestMonitor {
    /// Watches with the amplifier off where arm and pendulum come to rest after a motion, and
    /// stores their counts in `left_at`.
    ///
    /// # Errors
    /// A sample reports that the device is armed, although the device has confirmed that its motor
    /// is off.
    pub fn keep(
        &mut self,
        last: Option<&Measurement>,
        device: &mut dyn Device,
        clock: &dyn Clock,
        stop: &AtomicBool,
    ) -> Result<(), DeviceError> {
        let mut watch = RestWatch::after(last, self.encoders);
        let watched = watch_rest(&mut watch, self.waits_for, device, clock, stop);
        if matches!(watched, Err(NoRest::Armed)) {
            return Err(DeviceError::StaysArmed { port: self.port.clone() });
        }
        let rest = watched.ok().flatten();
        self.left_at =
            if watch.has_jumped() { Err(Moved::Jumped) } else { rest.ok_or(Moved::Unseen) };
        self.left_ns = clock.now_ns();
        Ok(())
    }

    /// Checks, after a motion that [`keep`](Self::keep) does not follow, that a sample does not
    /// contradict the device, which has confirmed that its motor is off. A missing sample does not.
    ///
    /// # Errors
    /// The sample reports that the device is armed.
    pub fn check_off(&self, device: &mut dyn Device, clock: &dyn Clock) -> Result<(), DeviceError> {
        let sample_time_ns = device.sample_time_ns().unwrap_or(SAMPLE_TIMEOUT_NS);
        match device.sample(clock.now_ns() + sample_time_ns) {
            Ok(sample) if sample.status.armed => {
                Err(DeviceError::StaysArmed { port: self.port.clone() })
            }
            Ok(_) | Err(_) => Ok(()),
        }
    }

    /// Checks that arm and pendulum are where they were left, before a rollout arms the device.
    ///
    /// # Errors
    /// Arm or pendulum has moved, does not come to rest, or was not seen at rest after the last
    /// motion; a stop is requested; the device is armed; the port is gone; the Qube is off; or Qube
    /// or board has restarted.
    pub fn compare(
        &mut self,
        settings: &TickSettings,
        device: &mut dyn Device,
        clock: &dyn Clock,
        stop: &AtomicBool,
    ) -> Result<(), ControlError> {
        let port = self.port.clone();
        let failed = |reason| match reason {
            NoRest::Armed => DeviceError::StaysArmed { port },
            NoRest::Link(LinkFault::Restarted) => DeviceError::Restarted { port },
            NoRest::Link(fault) => DeviceError::Link { port, fault },
        };
        let just_left = clock.now_ns().saturating_sub(self.left_ns) < SHORT_PAUSE_NS;
        let mut watch = RestWatch::new(self.encoders);
        let rest = watch_rest(&mut watch, WaitsFor::Rest, device, clock, stop).map_err(failed)?;
        let Some(rest) = rest else {
            let stopped = stop.load(Ordering::Relaxed);
            return Err(if stopped { ControlError::Stopped } else { Moved::Unseen.into() });
        };
        let left_at = self.left_at?;
        let zero_counts = settings.calibration.alpha_zero_counts;
        let compared = rest.compare(left_at, zero_counts, self.encoders);
        if just_left && matches!(compared, Err(Moved::Arm(_))) {
            self.waits_for = WaitsFor::Stillness;
        }
        Ok(compared?)
    }
}

/// The reason why arm and pendulum are not watched to the end.
#[derive(Clone, Copy, Debug)]
enum NoRest {
    /// The device reports that its motor is on.
    Armed,
    /// The port is gone, the Qube is off, or Qube or board has restarted.
    Link(LinkFault),
}

/// Samples at 100 Hz, at least once, until arm and pendulum are at rest, for at most
/// [`REST_TIME_NS`] and until `stop` is set; returns `None` if they are not at rest by then. If the
/// arm is to be still, sampling goes on until it is; an arm that is at rest without being still when
/// the time is over counts as at rest.
///
/// # Errors
/// The device is armed or gone ([`NoRest`]). Lost samples are tolerated.
fn watch_rest(
    watch: &mut RestWatch,
    waits_for: WaitsFor,
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
) -> Result<Option<RestingCounts>, NoRest> {
    let sample_time_ns = device.sample_time_ns().unwrap_or(SAMPLE_TIMEOUT_NS);
    let begin_ns = clock.now_ns();
    let mut deadline_ns = begin_ns;
    let mut rest = None;
    loop {
        match device.sample(clock.now_ns() + sample_time_ns) {
            Ok(sample) if sample.status.armed => return Err(NoRest::Armed),
            Ok(sample) => {
                rest = watch.update(&sample);
                if rest.is_some() && (waits_for == WaitsFor::Rest || watch.is_still()) {
                    return Ok(rest);
                }
            }
            Err(fault) if DeviceLoss::of(fault).is_some() => return Err(NoRest::Link(fault)),
            Err(_) => {}
        }
        deadline_ns = (deadline_ns + CONTROL_PERIOD_NS).max(clock.now_ns());
        if deadline_ns >= begin_ns + REST_TIME_NS || stop.load(Ordering::Relaxed) {
            return Ok(rest);
        }
        clock.sleep_until(deadline_ns);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::VirtualClock;
    use crate::safety::COOLED_LOAD;

    #[test]
    fn a_hot_motor_cools_down_before_the_next_motion_unless_a_stop_is_asked_for() {
        let clock = VirtualClock::default();
        let heat = MotorHeat { load: 0.85, ..MotorHeat::default() };
        let mut motor = MotorCooling { heat, off_since_ns: Some(0) };
        motor.cool_down(&clock, &AtomicBool::new(false));
        assert!((motor.heat.load - COOLED_LOAD).abs() < 1e-3, "{motor:?}");
        let waited_s = clock.now_ns() as f64 * 1e-9;
        assert!((waited_s - heat.cooling_s()).abs() < 1e-3, "{waited_s} s");

        let now_ns = clock.now_ns();
        let mut motor = MotorCooling { heat, off_since_ns: Some(now_ns) };
        motor.cool_down(&clock, &AtomicBool::new(true));
        assert_eq!((clock.now_ns(), motor.heat), (now_ns, heat));
    }
}
