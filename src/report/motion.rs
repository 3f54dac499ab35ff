use std::f64::consts::PI;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;

use super::nearest::Nearest;
use crate::qube::{CONTROL_PERIOD_S, QubeModel};
use crate::recording::Recording;
use crate::replay::{GuardApproach, MotionLog, OpenLoop};
use crate::telemetry::{Phase, TickRecord};

/// Unit of packed angles and voltages, rad or V: a milliradian is finer than an encoder's count,
/// and voltages are sent in millivolts. Packed values are limited to ±32.767 rad or V.
const UNIT: f64 = 1e-3;

/// The packed value that stands for no value.
const NONE: i16 = i16::MIN;

/// Largest number of ticks of a motion: five minutes. The limit keeps a recording of any origin
/// from making the page arbitrarily large.
const MAX_TICKS: usize = 30_000;

/// A rollout's motion for the page's player: its angles and voltages at equal time steps, packed as
/// 16-bit numbers in units of [`UNIT`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PackedMotion {
    group: String,
    name: String,
    note: String,
    first_s: f64,
    step_s: f64,
    #[serde(serialize_with = "packed")]
    theta: Vec<i16>,
    #[serde(serialize_with = "packed")]
    alpha: Vec<i16>,
    #[serde(serialize_with = "packed")]
    voltage: Vec<i16>,
    #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "packed")]
    simulated_theta: Vec<i16>,
    #[serde(skip_serializing_if = "Vec::is_empty", serialize_with = "packed")]
    simulated_alpha: Vec<i16>,
    phases: Vec<Began>,
    nearest: Vec<Near>,
    limits: Limits,
    arm_m: f64,
    pendulum_m: f64,
}

/// A phase, and the index of its first tick.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct Began {
    name: &'static str,
    from: usize,
}

/// A mark in a figure, at the time of a nearest approach to a limit.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Near {
    of: &'static str,
    time_s: f64,
    label: String,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct Limits {
    theta_rad: f64,
    alpha_rad: f64,
    voltage_v: f64,
}

impl PackedMotion {
    /// The motion of a recording, with the simulation of its voltages if there is one. Times count
    /// from the first tick of the policy, or from the first of all if the policy never drove the
    /// motor. `nearest` are the approaches to mark. Ticks beyond `MAX_TICKS` are left out.
    #[must_use]
    pub fn of(
        recording: &Recording,
        simulated: Option<(&MotionLog, &OpenLoop)>,
        nearest: &[Nearest],
    ) -> Self {
        let settings = &recording.header.settings;
        let first_tick = recording.ticks.first().map_or(0, |tick| tick.tick);
        let index = |tick: &TickRecord| tick.tick.wrapping_sub(first_tick) as usize;
        let length = recording.ticks.last().map_or(0, |last| index(last).saturating_add(1));
        let length = length.min(MAX_TICKS);
        let mut columns = [(); 3].map(|()| vec![NONE; length]);
        let mut phases: Vec<Began> = Vec::new();
        let turned_rad = turned_before_policy(&recording.ticks);
        for tick in recording.ticks.iter().filter(|tick| index(tick) < length) {
            let before = if tick.phase == Phase::Settling { turned_rad } else { 0.0 };
            let voltage_v = f64::from(tick.voltage_mv) * UNIT;
            let values = [tick.state.theta, tick.state.alpha - before, voltage_v];
            for (column, value) in columns.iter_mut().zip(values) {
                column[index(tick)] = pack(value);
            }
            let name = tick.phase.label();
            if phases.last().is_none_or(|phase| phase.name != name) {
                phases.push(Began { name, from: index(tick) });
            }
        }
        let policy_from = phases.iter().find(|phase| phase.name == Phase::Running.label());
        let policy_from = policy_from.map_or(0, |phase| phase.from);
        let mut motion = Self {
            group: String::new(),
            name: String::new(),
            note: String::new(),
            first_s: -(policy_from as f64) * CONTROL_PERIOD_S,
            step_s: CONTROL_PERIOD_S,
            theta: std::mem::take(&mut columns[0]),
            alpha: std::mem::take(&mut columns[1]),
            voltage: std::mem::take(&mut columns[2]),
            simulated_theta: Vec::new(),
            simulated_alpha: Vec::new(),
            phases,
            nearest: nearest.iter().filter_map(Near::of).collect(),
            limits: Limits {
                theta_rad: settings.safety_box.theta,
                alpha_rad: settings.safety_box.alpha,
                voltage_v: settings.plant.limits.largest_voltage_v,
            },
            arm_m: settings.plant.parameters.rotary_length_m,
            pendulum_m: settings.plant.parameters.pendulum_length_m,
        };
        if let Some((log, open_loop)) = simulated {
            motion.simulated_theta = vec![NONE; length];
            motion.simulated_alpha = vec![NONE; length];
            for (sample, state) in log.samples.iter().zip(&open_loop.simulated) {
                let at = policy_from + (sample.time_s / CONTROL_PERIOD_S).round() as usize;
                if at < length {
                    motion.simulated_theta[at] = pack(state.theta);
                    motion.simulated_alpha[at] = pack(state.alpha);
                }
            }
        }
        motion
    }

    /// Adds a mark where the guard was nearest to ending the policy, at this time from the policy's
    /// first tick, s.
    #[must_use]
    pub fn with_guard(mut self, guard: Option<(GuardApproach, f64)>) -> Self {
        self.nearest.extend(guard.map(|(approach, time_s)| {
            let foreseen = approach.foreseen;
            let label = format!(
                "guard: predicted {:.2} of {:.2} rad",
                foreseen.largest_rad, foreseen.end_rad
            );
            Near { of: "theta", time_s, label }
        }));
        self
    }

    /// Names the motion in the player's list, under a group; `note` is the sentence that the player
    /// shows with it.
    #[must_use]
    pub fn named(self, group: String, name: String, note: String) -> Self {
        Self { group, name, note, ..self }
    }

    /// Number of bytes that the motion takes in the page, as an estimate.
    pub fn bytes(&self) -> usize {
        let columns =
            [&self.theta, &self.alpha, &self.voltage, &self.simulated_theta, &self.simulated_alpha];
        // Base64 has four characters for three bytes; the rest has about 600 characters.
        600 + columns.iter().map(|column| 8 * column.len() / 3).sum::<usize>()
    }

    /// The motion thinned to every `stride`th tick; `stride` is at least 1.
    #[must_use]
    pub fn every(mut self, stride: usize) -> Self {
        let columns = [
            &mut self.theta,
            &mut self.alpha,
            &mut self.voltage,
            &mut self.simulated_theta,
            &mut self.simulated_alpha,
        ];
        for column in columns {
            *column = column.iter().copied().step_by(stride).collect();
        }
        for phase in &mut self.phases {
            phase.from = phase.from.div_ceil(stride).min(self.theta.len().saturating_sub(1));
        }
        self.step_s *= stride as f64;
        self
    }
}

impl Near {
    fn of(nearest: &Nearest) -> Option<Self> {
        let of = nearest.angle?;
        let label = format!("nearest: {:.0} %", 100.0 * nearest.share);
        Some(Self { of, time_s: nearest.time_s, label })
    }
}

/// The simulation of a recording's voltages by a model, with the recorded motion whose first state
/// it starts from; `None` if there is no motion, if the motion has a long interruption, or if the
/// simulation diverges.
#[must_use]
pub fn simulated(recording: &Recording, model: &QubeModel) -> Option<(MotionLog, OpenLoop)> {
    let log = MotionLog::of_recording(recording)?;
    let open_loop = crate::replay::simulate_from_first_state(&log, model).ok()?;
    Some((log, open_loop))
}

/// Angle of the whole turns by which alpha falls when the policy begins, rad: from then on the tick
/// counts the pendulum's turns from zero. The angle is 0 if the policy never begins.
fn turned_before_policy(ticks: &[TickRecord]) -> f64 {
    let begins =
        |pair: &&[TickRecord]| pair[0].phase != Phase::Running && pair[1].phase == Phase::Running;
    ticks.windows(2).find(begins).map_or(0.0, |pair| {
        let turns = (pair[0].state.alpha - pair[1].state.alpha) / (2.0 * PI);
        2.0 * PI * turns.round()
    })
}

fn pack(value: f64) -> i16 {
    if !value.is_finite() {
        return NONE;
    }
    (value / UNIT).round().clamp(f64::from(NONE) + 1.0, f64::from(i16::MAX)) as i16
}

fn packed<S: serde::Serializer>(column: &[i16], serializer: S) -> Result<S::Ok, S::Error> {
    let bytes: Vec<u8> = column.iter().flat_map(|value| value.to_le_bytes()).collect();
    serializer.serialize_str(&STANDARD.encode(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::State;
    use crate::recording::{Completeness, samples};

    fn recording(ticks: Vec<TickRecord>) -> Recording {
        Recording {
            header: samples::header(),
            policy: Vec::new(),
            ticks,
            outcome: Some(samples::outcome()),
            completeness: Completeness::Whole,
        }
    }

    fn tick(tick: u32, phase: Phase, theta: f64) -> TickRecord {
        let state = State { theta, ..State::default() };
        TickRecord { tick, phase, state, voltage_mv: -1500, ..TickRecord::default() }
    }

    #[test]
    fn ticks_keep_their_places_and_missing_ones_are_gaps() {
        let ticks = vec![
            tick(7, Phase::Settling, 0.5),
            tick(9, Phase::Running, -1.2345),
            tick(10, Phase::Running, f64::NAN),
        ];
        let motion = PackedMotion::of(&recording(ticks), None, &[]);
        assert_eq!(motion.theta, [500, NONE, -1235, NONE]);
        assert_eq!(motion.voltage, [-1500, NONE, -1500, -1500]);
        assert!((motion.first_s + 0.02).abs() < 1e-12);
        assert_eq!(motion.phases[1], Began { name: "policy", from: 2 });
        let thinned = motion.every(2);
        assert_eq!((thinned.theta.len(), thinned.step_s), (2, 0.02));
        assert_eq!(thinned.phases[1].from, 1);
    }

    #[test]
    fn a_hostile_recording_makes_no_large_page() {
        let ticks = vec![tick(0, Phase::Running, 1e300), tick(u32::MAX, Phase::Running, 0.0)];
        let motion = PackedMotion::of(&recording(ticks), None, &[]);
        assert_eq!(motion.theta.len(), MAX_TICKS);
        assert_eq!(motion.theta[0], i16::MAX);
        assert!(motion.bytes() < 400_000);
    }
}
