//! Watches arm and pendulum between two motions, so that no motion begins with zeros that no longer
//! hold.

use std::sync::atomic::{AtomicBool, Ordering};

use super::pause_watch::{PauseEvent, PauseWatch};
use super::{ControlError, DeviceLoss, Moved, RestWatch, RestingCounts, SAMPLE_TIMEOUT_NS};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, DeviceError, LinkFault};
use crate::qube::{CONTROL_PERIOD_NS, Encoders, Measurement};
use crate::telemetry::TickSettings;

/// Time that arm and pendulum may take to come to rest with the amplifier off, ns. If they do not,
/// the arm is homed before the next rollout.
const REST_TIME_NS: Nanoseconds = 15_000_000_000;

/// Pause between two motions, ns, below which an arm that has moved meanwhile was not at rest at
/// the beginning of the pause.
const SHORT_PAUSE_NS: Nanoseconds = 5_000_000_000;

/// Largest angle by which a cable is assumed to pull a resting arm, rad: between two homings if the
/// arm is watched, within one pause after homing by hand. On `lab` it pulls by 0.1 rad in 10 s. A
/// count that drifts as slowly while the arm stays makes the zero wrong by as much.
pub const LARGEST_CREEP_RAD: f64 = 0.35;

/// The state that ends a watch of arm and pendulum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WaitsFor {
    /// Both are at rest.
    Rest,
    /// Both are at rest, and the arm is [still](RestWatch::is_still).
    Stillness,
}

/// Counts at which a motion has left arm and pendulum.
#[derive(Clone, Copy, Debug)]
pub(super) struct Left {
    /// Counts at which they came to rest after the motion.
    came_to_rest: RestingCounts,
    /// Counts at which they were at rest in the last sample of the pause that was watched.
    at_rest: RestingCounts,
}

/// Knowledge about the encoder counts between motions.
#[derive(Debug)]
pub(super) struct RestMonitor {
    /// Name of the port for errors.
    pub port: String,
    /// Counts at which the last motion left arm and pendulum, or the reason why they are not known.
    pub left_at: Result<Left, Moved>,
    /// Encoders of the plant that was homed.
    pub encoders: Encoders,
    /// Counts by which the arm has crept in all watched pauses since the last homing.
    pub crept_counts: i32,
    /// Time at which arm and pendulum came to rest after the last motion, ns.
    pub left_ns: Nanoseconds,
    /// The state that ends the watch after each motion. It becomes [`WaitsFor::Stillness`] for as
    /// long as the device stays open once the arm has moved within a pause shorter than
    /// [`SHORT_PAUSE_NS`], because a cable may pull the arm away after each motion. In a longer
    /// pause, such as a training, an arm that was at rest may creep away; to follow it, or to home
    /// it again, then costs less time than waiting after each motion.
    pub waits_for: WaitsFor,
    /// The watch in the pause since the last motion, while it goes on.
    pub pause: Option<PauseWatch>,
}

impl Default for RestMonitor {
    fn default() -> Self {
        Self {
            port: String::new(),
            left_at: Err(Moved::Unseen),
            encoders: Encoders::default(),
            crept_counts: 0,
            left_ns: 0,
            waits_for: WaitsFor::Rest,
            pause: None,
        }
    }
}

impl RestMonitor {
    /// Watches with the amplifier off where arm and pendulum come to rest after a motion, and
    /// stores their counts in `left_at`. If time passes by itself, the watch goes on in the pause.
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
        let left = rest.map(|rest| Left { came_to_rest: rest, at_rest: rest });
        self.left_at = if watch.has_jumped_or_drifted() {
            Err(Moved::Jumped)
        } else {
            left.ok_or(Moved::Unseen)
        };
        self.left_ns = clock.now_ns();
        self.pause = (self.left_at.is_ok() && clock.passes_by_itself())
            .then(|| PauseWatch::new(watch, self.encoders, self.left_ns));
        Ok(())
    }

    /// Returns whether the counts are watched in the pause since the last motion.
    pub fn watches_pause(&self) -> bool {
        self.pause.is_some()
    }

    /// Takes one sample of the pause since the last motion, and waits until the next is due. An arm
    /// that creeps is followed. The watch ends where the arm's count changes in another way, which
    /// means homing again, and when its time is over.
    pub fn watch_pause(&mut self, device: &mut dyn Device, clock: &dyn Clock) {
        let (Some(mut pause), Ok(left)) = (self.pause.take(), self.left_at) else { return };
        let sample_time_ns = device.sample_time_ns().unwrap_or(SAMPLE_TIMEOUT_NS);
        let next_ns = clock.now_ns() + CONTROL_PERIOD_NS;
        let goes_on = match device.sample(clock.now_ns() + sample_time_ns) {
            // The next motion finds out, and reports, that the motor is on or the device is lost.
            Ok(sample) if sample.status.armed => false,
            Err(fault) => DeviceLoss::of(fault).is_none() && !pause.is_over(clock.now_ns()),
            Ok(sample) => self.follow(left, pause.update(&sample, clock.now_ns(), left.at_rest)),
        };
        if goes_on {
            self.pause = Some(pause);
            clock.sleep_until(next_ns);
        }
    }

    /// Ends the watch of a pause, because the device is used for something else.
    pub fn end_pause(&mut self) {
        self.pause = None;
    }

    /// Stores where the arm is at rest now, if it has crept by no more than [`LARGEST_CREEP_RAD`]
    /// since the last homing. Else `left_at` becomes the reason why its zero does not hold. Returns
    /// whether the watch goes on.
    fn follow(&mut self, left: Left, seen: PauseEvent) -> bool {
        match seen {
            PauseEvent::GoesOn => true,
            PauseEvent::Over => false,
            PauseEvent::Changed(moved) => {
                self.left_at = Err(moved);
                false
            }
            PauseEvent::Rests(rest) => {
                let crept_counts = self.crept_counts + rest.arm_counts_since(left.at_rest);
                let crept_rad = self.encoders.theta.angle_rad(crept_counts);
                let is_credible = crept_rad.abs() <= LARGEST_CREEP_RAD;
                if is_credible {
                    self.left_at = Ok(Left { at_rest: rest, ..left });
                    self.crept_counts = crept_counts;
                } else {
                    self.left_at = Err(self.arm_moved(rest, left));
                }
                is_credible
            }
        }
    }

    /// The change of the arm's count from where the last motion left it to this rest. A count that
    /// jumps back by as much as the arm has crept has moved, too.
    fn arm_moved(&self, rest: RestingCounts, left: Left) -> Moved {
        let moved = [left.came_to_rest, left.at_rest].map(|before| rest.arm_counts_since(before));
        let counts = moved.into_iter().max_by_key(|counts| counts.unsigned_abs());
        Moved::Arm(self.encoders.theta.angle_rad(counts.unwrap_or_default()))
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
        let unbroken = self.pause.take().and_then(|pause| pause.unbroken(clock.now_ns()));
        let mut watch = unbroken.unwrap_or_else(|| RestWatch::new(self.encoders));
        let rest = watch_rest(&mut watch, WaitsFor::Rest, device, clock, stop).map_err(failed)?;
        let Some(rest) = rest else {
            let stopped = stop.load(Ordering::Relaxed);
            return Err(if stopped { ControlError::Stopped } else { Moved::Unseen.into() });
        };
        let zero_counts = settings.calibration.alpha_zero_counts;
        let compared = self.left_at.and_then(|left| {
            match rest.compare(left.at_rest, zero_counts, self.encoders) {
                Err(Moved::Arm(_)) => Err(self.arm_moved(rest, left)),
                compared => compared,
            }
        });
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
