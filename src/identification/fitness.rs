use thiserror::Error;

use super::stretch::duration_of;
use crate::qube::{Encoder, Encoders, State};
use crate::replay::{MotionLog, MotionSample};

/// Shortest recording that [`check_recording`] accepts, s.
const SHORTEST_S: f64 = 2.0;

/// Longest time between two samples that is no interruption, s: two control periods, after one lost
/// sample.
const LONGEST_STEP_S: f64 = 0.021;

/// Longest interruption, s: three lost samples in a row, as many as a rollout tolerates. The last
/// voltage was held meanwhile, so an interruption can be simulated like any other step.
const LONGEST_INTERRUPTION_S: f64 = 0.045;

/// Largest share of the steps that are interruptions.
const INTERRUPTIONS_SHARE: f64 = 0.02;

/// Voltage, of either sign, that a recording must reach at least once, V.
const LEAST_VOLTAGE_V: f64 = 0.5;

/// Largest voltage that a recording may have, V: the supply of a motor several times as large as a
/// Qube's. A larger number is probably in mV.
const LARGEST_VOLTAGE_V: f64 = 48.0;

/// Smallest range of the motion of each angle in a recording, rad.
const LEAST_MOTION_RAD: f64 = 0.1;

/// Smallest distance of the arm from its hard stop, rad.
const STOP_MARGIN_RAD: f64 = 0.02;

/// Longest time for which a count may stay constant while it should move, s.
const LONGEST_STILL_S: f64 = 0.3;

/// Voltage that turns any arm as long as its sign does not change, V.
const TURNING_VOLTAGE_V: f64 = 1.0;

/// Largest motion of the arm while the pendulum's count stays constant, rad.
const ARM_ALONE_RAD: f64 = 0.3;

/// Largest swing of the pendulum while the arm's count stays constant, rad. A pendulum that swings
/// farther pulls on the arm with several times any friction.
const PENDULUM_ALONE_RAD: f64 = 0.6;

/// Largest velocity of a Qube's arm or pendulum, rad/s.
const FASTEST_RAD_S: f64 = 80.0;

/// Tolerance for noise in a single step, rad.
const STEP_TOLERANCE_RAD: f64 = 0.1;

/// Smallest step, in counts, after which an angle that stays at its extreme counts as clipped:
/// before a true turning point the angle slows down.
const CLIPPED_STEP_COUNTS: f64 = 4.5;

/// Number of samples for which a clipped angle stays at its extreme.
const CLIPPED_SAMPLES: usize = 4;

/// Accepted ratio of an angle's motion to its integrated velocity. A velocity filter underestimates
/// slightly (1.02 to 1.10 in recordings of a real Qube through 50 s/(s+50)); outside these bounds
/// the times are wrong, since another sampling rate is mostly off by 2 or more.
const RATE_FACTORS: std::ops::RangeInclusive<f64> = 0.8..=1.8;

/// Velocity (root mean square) below which the ratio is not checked, rad/s.
const RATE_SPEED_RAD_S: f64 = 0.5;

/// The reason why a recording cannot be fitted. Times count from the recording's start.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Unfit {
    /// A time, an angle, a velocity or a voltage is no finite number.
    #[error("its sample {sample} holds a number that is not finite")]
    NotFinite {
        /// Number of the sample, from 0.
        sample: usize,
    },
    /// Time does not go on from one sample to the next.
    #[error("its sample {sample} is not later than the one before")]
    TimeDoesNotAdvance {
        /// Number of the sample, from 0.
        sample: usize,
    },
    /// The recording is too short.
    #[error("it lasts {duration_s:.2} s; give at least {shortest_s} s")]
    Short {
        /// Duration of the recording, s.
        duration_s: f64,
        /// Smallest accepted duration, s.
        shortest_s: f64,
    },
    /// Too many samples are missing, an interruption is too long, or the sampling is too slow.
    #[error(
        "{step_s:.3} s without a sample at {at_s:.3} s: give at least 50 samples a second; at most 2 % of them \
         may come more than {LONGEST_STEP_S} s after the one before, and none more than {LONGEST_INTERRUPTION_S} s"
    )]
    Interrupted {
        /// Time since the start at which the longest interruption begins, s.
        at_s: f64,
        /// Length of the longest interruption, from sample to sample, s.
        step_s: f64,
    },
    /// The voltage never reached 0.5 V.
    #[error(
        "no excitation: the voltage never reached {LEAST_VOLTAGE_V} V; give a motion under larger voltages"
    )]
    NoVoltage,
    /// A voltage is larger than any supply of a small motor.
    #[error(
        "the voltage reaches {voltage_v:.0} V, and the motor of a plant like this takes {LARGEST_VOLTAGE_V} V at most: give \
         voltages in V, not in mV"
    )]
    NotVolts {
        /// The largest voltage, V.
        voltage_v: f64,
    },
    /// An angle moved by less than 0.1 rad.
    #[error(
        "no excitation: {angle} moved by {moved_rad:.3} rad; at least {LEAST_MOTION_RAD} rad are needed"
    )]
    NoMotion {
        /// Name of the angle.
        angle: &'static str,
        /// Range of its motion, rad.
        moved_rad: f64,
    },
    /// The arm came within 0.02 rad of its stop, whose contact the equations do not describe.
    #[error(
        "the arm came to {theta_rad:.2} rad at {at_s:.3} s, too close to its hard stop at {hard_stop_rad} rad: \
         give a motion that keeps away from the stop"
    )]
    AtStop {
        /// Time since the start, s.
        at_s: f64,
        /// Angle of the arm, rad.
        theta_rad: f64,
        /// Angle of the stop, rad.
        hard_stop_rad: f64,
    },
    /// An angle jumps between two samples.
    #[error(
        "{angle} jumps by {jump_rad:.2} rad at {at_s:.3} s: a loose encoder, or an angle that was \
         wrapped to one turn, which has to be unwrapped"
    )]
    Jump {
        /// Name of the angle.
        angle: &'static str,
        /// Time since the start, s.
        at_s: f64,
        /// Change of the angle by the jump, rad.
        jump_rad: f64,
    },
    /// An angle stops abruptly at its largest or smallest value.
    #[error("clipped: {angle} is cut off at {value_rad:.2} rad at {at_s:.3} s")]
    Clipped {
        /// Name of the angle.
        angle: &'static str,
        /// Time since the start, s.
        at_s: f64,
        /// Value at which it stops, rad.
        value_rad: f64,
    },
    /// The recorded velocities of an angle do not match its motion between the sampling times.
    #[error(
        "it was not recorded at these times: {angle} moves {factor:.2} times as fast as its velocities \
         say. Was it recorded at another rate?"
    )]
    OtherRate {
        /// Name of the angle.
        angle: &'static str,
        /// Velocity that follows from angle and times, divided by the recorded velocity (root mean
        /// squares).
        factor: f64,
    },
    /// The arm's count stays constant under voltage.
    #[error(
        "the arm's count stands still from {at_s:.3} s on under {voltage_v:.2} V: the arm was stalled \
         or its encoder unplugged"
    )]
    FrozenArm {
        /// Time since the start, s.
        at_s: f64,
        /// Voltage at the motor, V.
        voltage_v: f64,
    },
    /// The arm's count stays constant while the pendulum swings.
    #[error(
        "the arm's count stands still from {at_s:.3} s on while the pendulum swings: the arm was held \
         or its encoder unplugged"
    )]
    FrozenArmUnderPendulum {
        /// Time since the start, s.
        at_s: f64,
    },
    /// The pendulum's count stays constant while the arm moves.
    #[error(
        "the pendulum's count stands still from {at_s:.3} s on while the arm turns: its encoder was \
         unplugged"
    )]
    FrozenPendulum {
        /// Time since the start, s.
        at_s: f64,
    },
}

impl Unfit {
    /// Returns whether the recording shows no defect, but is too short, has too little voltage or
    /// motion, or comes near a stop.
    pub(super) fn is_unusable(self) -> bool {
        matches!(
            self,
            Self::Short { .. } | Self::NoVoltage | Self::NoMotion { .. } | Self::AtStop { .. }
        )
    }
}

/// Checks that a recording can be fitted.
///
/// # Errors
/// Names the first reason why it cannot.
pub fn check_recording(log: &MotionLog) -> Result<(), Unfit> {
    check_motion(log, SHORTEST_S)
}

/// Checks that a motion lasts at least `shortest_s` seconds and can be fitted.
pub(super) fn check_motion(log: &MotionLog, shortest_s: f64) -> Result<(), Unfit> {
    let samples = &log.samples;
    check_numbers(samples)?;
    let duration_s = duration_of(samples);
    if duration_s < shortest_s {
        return Err(Unfit::Short { duration_s, shortest_s });
    }
    let start_s = samples[0].time_s;
    check_times(samples)?;
    if samples.iter().all(|sample| sample.voltage_v.abs() < LEAST_VOLTAGE_V) {
        return Err(Unfit::NoVoltage);
    }
    let voltage_v = samples.iter().map(|sample| sample.voltage_v.abs()).fold(0.0, f64::max);
    if voltage_v > LARGEST_VOLTAGE_V {
        return Err(Unfit::NotVolts { voltage_v });
    }
    let hard_stop_rad = log.plant.limits.hard_stop_rad;
    let at_stop = |it: &&MotionSample| it.state.theta.abs() > hard_stop_rad - STOP_MARGIN_RAD;
    if let Some(sample) = samples.iter().find(at_stop) {
        let (at_s, theta_rad) = (sample.time_s - start_s, sample.state.theta);
        return Err(Unfit::AtStop { at_s, theta_rad, hard_stop_rad });
    }
    for angle in ANGLES {
        jump(samples, angle)?;
    }
    frozen(samples, start_s, log.plant.encoders)?;
    for angle in ANGLES {
        let values: Vec<f64> = samples.iter().map(|sample| (angle.of)(&sample.state)).collect();
        let moved_rad = values.iter().copied().fold(Extent::NONE, Extent::with).width();
        if moved_rad < LEAST_MOTION_RAD {
            return Err(Unfit::NoMotion { angle: angle.name, moved_rad });
        }
        clipped(samples, &values, angle, (angle.encoder)(&log.plant.encoders))?;
        other_rate(samples, angle)?;
    }
    Ok(())
}

/// Checks that every number is finite and that time goes on.
fn check_numbers(samples: &[MotionSample]) -> Result<(), Unfit> {
    let is_finite = |sample: &MotionSample| {
        let State { theta, alpha, theta_dot, alpha_dot } = sample.state;
        [sample.time_s, theta, alpha, theta_dot, alpha_dot, sample.voltage_v]
            .iter()
            .all(|number| number.is_finite())
    };
    if let Some(sample) = samples.iter().position(|sample| !is_finite(sample)) {
        return Err(Unfit::NotFinite { sample });
    }
    match samples.windows(2).position(|pair| pair[1].time_s <= pair[0].time_s) {
        Some(before) => Err(Unfit::TimeDoesNotAdvance { sample: before + 1 }),
        None => Ok(()),
    }
}

/// Checks that interruptions are few and short; names the longest.
fn check_times(samples: &[MotionSample]) -> Result<(), Unfit> {
    let steps = samples.windows(2).map(|pair| (pair[0].time_s, pair[1].time_s - pair[0].time_s));
    let interruptions: Vec<(f64, f64)> =
        steps.filter(|(_, step_s)| *step_s > LONGEST_STEP_S).collect();
    let longest = interruptions.iter().copied().max_by(|one, other| one.1.total_cmp(&other.1));
    let few = interruptions.len() as f64 <= INTERRUPTIONS_SHARE * samples.len() as f64;
    match longest {
        Some((time_s, step_s)) if !few || step_s > LONGEST_INTERRUPTION_S => {
            Err(Unfit::Interrupted { at_s: time_s - samples[0].time_s, step_s })
        }
        _ => Ok(()),
    }
}

/// One of the two angles.
#[derive(Clone, Copy)]
struct Angle {
    name: &'static str,
    of: fn(&State) -> f64,
    velocity_of: fn(&State) -> f64,
    encoder: fn(&Encoders) -> Encoder,
}

const ANGLES: [Angle; 2] = [
    Angle {
        name: "theta",
        of: |state| state.theta,
        velocity_of: |state| state.theta_dot,
        encoder: |encoders| encoders.theta,
    },
    Angle {
        name: "alpha",
        of: |state| state.alpha,
        velocity_of: |state| state.alpha_dot,
        encoder: |encoders| encoders.alpha,
    },
];

/// Looks for a step larger than any motion can make.
fn jump(samples: &[MotionSample], angle: Angle) -> Result<(), Unfit> {
    for pair in samples.windows(2) {
        let step_s = pair[1].time_s - pair[0].time_s;
        let jump_rad = (angle.of)(&pair[1].state) - (angle.of)(&pair[0].state);
        if jump_rad.abs() > FASTEST_RAD_S * step_s + STEP_TOLERANCE_RAD {
            let at_s = pair[1].time_s - samples[0].time_s;
            return Err(Unfit::Jump { angle: angle.name, at_s, jump_rad });
        }
    }
    Ok(())
}

/// Looks for an angle that stops abruptly at its extreme and stays there.
fn clipped(
    samples: &[MotionSample],
    values: &[f64],
    angle: Angle,
    encoder: Encoder,
) -> Result<(), Unfit> {
    let rad_per_count = encoder.rad_per_count();
    let lowest = values.iter().copied().fold(f64::INFINITY, f64::min);
    let highest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    for (index, run) in values.windows(CLIPPED_SAMPLES + 1).enumerate() {
        let stays_at = |extreme: f64| {
            run[1..].iter().all(|value| (value - extreme).abs() < 0.5 * rad_per_count)
        };
        let step_counts = (run[1] - run[0]).abs() / rad_per_count;
        if step_counts > CLIPPED_STEP_COUNTS && (stays_at(lowest) || stays_at(highest)) {
            let at_s = samples[index + 1].time_s - samples[0].time_s;
            return Err(Unfit::Clipped { angle: angle.name, at_s, value_rad: run[1] });
        }
    }
    Ok(())
}

/// Compares the motion of an angle in 50 ms with its integrated velocities, which a filter delays
/// but hardly scales. Slow motions and recordings without velocities are not checked.
fn other_rate(samples: &[MotionSample], angle: Angle) -> Result<(), Unfit> {
    let (mut slopes, mut velocities, mut count) = (0.0, 0.0, 0);
    let mut first = 0;
    while let Some(end) =
        (first..samples.len()).find(|&index| samples[index].time_s - samples[first].time_s >= 0.05)
    {
        let duration_s = samples[end].time_s - samples[first].time_s;
        let moved = (angle.of)(&samples[end].state) - (angle.of)(&samples[first].state);
        let swept: f64 = samples[first..=end]
            .windows(2)
            .map(|pair| (angle.velocity_of)(&pair[1].state) * (pair[1].time_s - pair[0].time_s))
            .sum();
        slopes += (moved / duration_s).powi(2);
        velocities += (swept / duration_s).powi(2);
        count += 1;
        first = end;
    }
    let rms = |squares: f64| (squares / f64::from(count.max(1))).sqrt();
    let (slope, velocity) = (rms(slopes), rms(velocities));
    if slope < RATE_SPEED_RAD_S || velocity == 0.0 {
        return Ok(());
    }
    let factor = slope / velocity;
    if RATE_FACTORS.contains(&factor) {
        Ok(())
    } else {
        Err(Unfit::OtherRate { angle: angle.name, factor })
    }
}

/// Looks for a count that stays constant for 0.3 s while voltage or the other angle should move it.
fn frozen(samples: &[MotionSample], start_s: f64, encoders: Encoders) -> Result<(), Unfit> {
    let [theta_rad, alpha_rad] = [encoders.theta, encoders.alpha].map(|own| own.rad_per_count());
    // Indices of three samples: since the first the arm's count has been constant under a turning
    // voltage of one sign, since the second the pendulum's count has been constant, and since the
    // third the arm's count has been constant under any voltage. A change of the arm's count by up
    // to two counts is no motion.
    let (mut arm_since, mut pendulum_since, mut held_since) = (0, 0, 0);
    // Extent of each angle while the other's count has been constant.
    let (mut arm, mut pendulum) = (Extent::NONE, Extent::NONE);
    for (now, sample) in samples.iter().enumerate() {
        let of = |index: usize| &samples[index];
        let same = |one: f64, other: f64| (one - other).abs() <= 2.01 * theta_rad;
        let turning = sample.voltage_v.abs() >= TURNING_VOLTAGE_V
            && sample.voltage_v * of(arm_since).voltage_v > 0.0;
        if !turning || !same(sample.state.theta, of(arm_since).state.theta) {
            arm_since = now;
        }
        if sample.time_s - of(arm_since).time_s >= LONGEST_STILL_S {
            let at_s = of(arm_since).time_s - start_s;
            return Err(Unfit::FrozenArm { at_s, voltage_v: sample.voltage_v });
        }
        if !same(sample.state.theta, of(held_since).state.theta) {
            held_since = now;
            pendulum = Extent::NONE;
        }
        pendulum = pendulum.with(sample.state.alpha);
        if sample.time_s - of(held_since).time_s >= LONGEST_STILL_S
            && pendulum.width() > PENDULUM_ALONE_RAD
        {
            let at_s = of(held_since).time_s - start_s;
            return Err(Unfit::FrozenArmUnderPendulum { at_s });
        }
        if (sample.state.alpha - of(pendulum_since).state.alpha).abs() > 0.5 * alpha_rad {
            pendulum_since = now;
            arm = Extent::NONE;
        }
        arm = arm.with(sample.state.theta);
        if sample.time_s - of(pendulum_since).time_s >= LONGEST_STILL_S
            && arm.width() > ARM_ALONE_RAD
        {
            return Err(Unfit::FrozenPendulum { at_s: of(pendulum_since).time_s - start_s });
        }
    }
    Ok(())
}

/// The smallest interval that contains some values.
#[derive(Clone, Copy, Debug)]
struct Extent {
    low: f64,
    high: f64,
}

impl Extent {
    /// The extent of no value.
    const NONE: Self = Self { low: f64::INFINITY, high: f64::NEG_INFINITY };

    fn with(self, value: f64) -> Self {
        Self { low: self.low.min(value), high: self.high.max(value) }
    }

    fn width(self) -> f64 {
        self.high - self.low
    }
}
