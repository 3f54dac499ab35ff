use thiserror::Error;

use super::stretch::duration_of;
use crate::qube::{HARD_STOP_RAD, RAD_PER_COUNT};
use crate::replay::{MotionLog, MotionSample};

/// The shortest recording that is fitted, s.
const SHORTEST_S: f64 = 2.0;

/// The longest time between two samples, s: a control tick with one sample lost.
const LONGEST_STEP_S: f64 = 0.021;

/// What the motor must have got at least once, V, and how far both angles must have moved, rad.
const LEAST_VOLTAGE_V: f64 = 0.5;
const LEAST_MOTION_RAD: f64 = 0.1;

/// How near to the hard stop the arm may have come, rad.
const STOP_MARGIN_RAD: f64 = 0.02;

/// For how long a count may stand still while it should move, s.
const LONGEST_STILL_S: f64 = 0.3;

/// A voltage of one sign that turns any arm, V.
const TURNING_VOLTAGE_V: f64 = 1.0;

/// How far the arm may go while the pendulum's count stands still, rad.
const ARM_ALONE_RAD: f64 = 0.3;

/// Why a recording says nothing of the Qube that made it, or something wrong. Times count from the
/// recording's start.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Unfit {
    /// Too little of it.
    #[error("it lasts {duration_s:.2} s; give at least {SHORTEST_S} s")]
    Short {
        /// How long it is.
        duration_s: f64,
    },
    /// Samples are missing, or it was recorded too slowly.
    #[error(
        "{step_s:.3} s without a sample at {at_s:.3} s; recordings need at least 50 samples a second \
         without gaps"
    )]
    Gap {
        /// Since the start.
        at_s: f64,
        /// The time between two samples.
        step_s: f64,
    },
    /// The motor did nothing.
    #[error("no excitation: the voltage never went beyond {LEAST_VOLTAGE_V} V")]
    NoVoltage,
    /// Nothing moved.
    #[error(
        "no excitation: {angle} moved by {moved_rad:.3} rad; at least {LEAST_MOTION_RAD} rad are needed"
    )]
    NoMotion {
        /// Which angle.
        angle: &'static str,
        /// How far.
        moved_rad: f64,
    },
    /// The arm hit its stop, which no equation here describes.
    #[error(
        "clipped: the arm came to {theta_rad:.2} rad at {at_s:.3} s, the hard stop is at {HARD_STOP_RAD} rad"
    )]
    AtStop {
        /// Since the start.
        at_s: f64,
        /// Where the arm was.
        theta_rad: f64,
    },
    /// The arm's count stood still under voltage.
    #[error(
        "the arm's count stands still from {at_s:.3} s on under {voltage_v:.2} V: the arm was stalled \
         or its encoder unplugged"
    )]
    FrozenArm {
        /// Since the start.
        at_s: f64,
        /// The voltage.
        voltage_v: f64,
    },
    /// The pendulum's count stood still while the arm swung.
    #[error(
        "the pendulum's count stands still from {at_s:.3} s on while the arm turns: its encoder was \
         unplugged"
    )]
    FrozenPendulum {
        /// Since the start.
        at_s: f64,
    },
}

/// Whether a recording can be fitted.
///
/// # Errors
/// The first reason why not.
pub fn check_recording(log: &MotionLog) -> Result<(), Unfit> {
    let samples = &log.samples;
    let duration_s = duration_of(samples);
    if duration_s < SHORTEST_S {
        return Err(Unfit::Short { duration_s });
    }
    let start_s = samples[0].time_s;
    for pair in samples.windows(2) {
        let step_s = pair[1].time_s - pair[0].time_s;
        if step_s > LONGEST_STEP_S {
            return Err(Unfit::Gap { at_s: pair[0].time_s - start_s, step_s });
        }
    }
    if samples.iter().all(|sample| sample.voltage_v.abs() < LEAST_VOLTAGE_V) {
        return Err(Unfit::NoVoltage);
    }
    let at_stop = |s: &&MotionSample| s.state.theta.abs() > HARD_STOP_RAD - STOP_MARGIN_RAD;
    if let Some(sample) = samples.iter().find(at_stop) {
        let (at_s, theta_rad) = (sample.time_s - start_s, sample.state.theta);
        return Err(Unfit::AtStop { at_s, theta_rad });
    }
    frozen(samples, start_s)?;
    for (angle, values) in [
        ("theta", samples.iter().map(|s| s.state.theta).collect::<Vec<_>>()),
        ("alpha", samples.iter().map(|s| s.state.alpha).collect()),
    ] {
        let moved_rad = range(&values);
        if moved_rad < LEAST_MOTION_RAD {
            return Err(Unfit::NoMotion { angle, moved_rad });
        }
    }
    Ok(())
}

/// Looks for a count that stands still for 0.3 s while something says that it should not.
fn frozen(samples: &[MotionSample], start_s: f64) -> Result<(), Unfit> {
    // Where each angle stood still, and the voltage had one sign, since.
    let (mut arm_since, mut pendulum_since) = (0, 0);
    for (now, sample) in samples.iter().enumerate() {
        let of = |index: usize| &samples[index];
        let same = |a: f64, b: f64| (a - b).abs() <= 2.01 * RAD_PER_COUNT;
        let turning = sample.voltage_v.abs() >= TURNING_VOLTAGE_V
            && sample.voltage_v * of(arm_since).voltage_v > 0.0;
        if !turning || !same(sample.state.theta, of(arm_since).state.theta) {
            arm_since = now;
        }
        if sample.time_s - of(arm_since).time_s >= LONGEST_STILL_S {
            let at_s = of(arm_since).time_s - start_s;
            return Err(Unfit::FrozenArm { at_s, voltage_v: sample.voltage_v });
        }
        if (sample.state.alpha - of(pendulum_since).state.alpha).abs() > 0.5 * RAD_PER_COUNT {
            pendulum_since = now;
        }
        let arm: Vec<f64> = samples[pendulum_since..=now].iter().map(|s| s.state.theta).collect();
        if sample.time_s - of(pendulum_since).time_s >= LONGEST_STILL_S
            && range(&arm) > ARM_ALONE_RAD
        {
            return Err(Unfit::FrozenPendulum { at_s: of(pendulum_since).time_s - start_s });
        }
    }
    Ok(())
}

fn range(values: &[f64]) -> f64 {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max) - low
}
