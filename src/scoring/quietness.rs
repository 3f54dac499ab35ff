use serde::Serialize;

use super::criterion::{is_about_upright, running};
use crate::qube::{CONTROL_PERIOD_S, PlantModel};
use crate::telemetry::TickRecord;

/// Number of ticks for which the pendulum is nearly upright before balancing begins: half a second,
/// after which swing-up and catch are over.
const CATCH_TICKS: usize = 50;

/// Mean change of the voltage above which balancing is loud, V a tick. The preset `robust` trains
/// for less than 0.3; its policies around identified Qubes change 0.2 to 0.45
/// (`scripts/session-study.py`), and policies that are trained without a penalty for voltage
/// changes 1 to 3.
const LOUD_CHANGE_V: f64 = 0.6;

/// Sign changes of the voltage above which balancing is loud, 1/s: twice the number that the preset
/// `robust` trains for; policies that are trained without a penalty for voltage changes make 55 to
/// 80.
const LOUD_SIGN_CHANGES_PER_S: f64 = 40.0;

/// The quietness of balancing over the recorded ticks of any number of rollouts: size and frequency
/// of voltage changes, and their cost.
///
/// A tick counts if the policy drives the motor and the pendulum has been nearly upright for the
/// half second before the tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quietness {
    ticks: u64,
    changes_v: f64,
    sign_changes: u64,
    squares_v2: f64,
    losses_w: f64,
}

/// The figures of a [`Quietness`], for scripts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct QuietnessFigures {
    /// Mean absolute change of the voltage between ticks, V.
    pub change_v: f64,
    /// Sign changes of the voltage per second; a change to or from 0 V is none.
    pub sign_changes_per_s: f64,
    /// Root mean square voltage, V.
    pub rms_v: f64,
    /// Mean heat in the motor's winding, W.
    pub copper_loss_w: f64,
}

impl Default for Quietness {
    fn default() -> Self {
        Self::NONE
    }
}

impl Quietness {
    /// The quietness of no ticks.
    pub const NONE: Self =
        Self { ticks: 0, changes_v: 0.0, sign_changes: 0, squares_v2: 0.0, losses_w: 0.0 };

    /// Quietness of the balancing part of one rollout of a plant.
    #[must_use]
    pub fn of(ticks: &[TickRecord], plant: &PlantModel) -> Self {
        let mut quietness = Self::NONE;
        quietness.add(ticks, plant);
        quietness
    }

    /// Adds the balancing part of one rollout of a plant.
    pub fn add(&mut self, ticks: &[TickRecord], plant: &PlantModel) {
        let mut ticks_up = 0;
        for pair in running(ticks).windows(2) {
            ticks_up = if is_about_upright(&pair[1].state) { ticks_up + 1 } else { 0 };
            if ticks_up > CATCH_TICKS {
                self.add_tick(pair[0], pair[1], plant);
            }
        }
    }

    /// Adds every tick of these except the first, for any motion of the pendulum.
    pub(super) fn add_stretch(&mut self, ticks: &[&TickRecord], plant: &PlantModel) {
        for pair in ticks.windows(2) {
            self.add_tick(pair[0], pair[1], plant);
        }
    }

    /// Adds one tick and the change of the voltage since the tick before.
    fn add_tick(&mut self, before: &TickRecord, tick: &TickRecord, plant: &PlantModel) {
        let (last_mv, now_mv) = (before.voltage_mv, tick.voltage_mv);
        let voltage_v = tick.voltage_v();
        self.ticks += 1;
        self.changes_v += (voltage_v - before.voltage_v()).abs();
        self.sign_changes += u64::from(i32::from(last_mv) * i32::from(now_mv) < 0);
        self.squares_v2 += voltage_v * voltage_v;
        self.losses_w += copper_loss_w(voltage_v, tick.state.theta_dot, plant);
    }

    /// Adds the counts of another quietness.
    pub fn merge(&mut self, other: &Self) {
        self.ticks += other.ticks;
        self.changes_v += other.changes_v;
        self.sign_changes += other.sign_changes;
        self.squares_v2 += other.squares_v2;
        self.losses_w += other.losses_w;
    }

    /// Returns whether balancing is loud: it buzzes audibly, heats the motor and wears its brushes.
    #[must_use]
    pub fn is_loud(&self) -> bool {
        self.figures().is_some_and(|figures| {
            figures.change_v > LOUD_CHANGE_V || figures.sign_changes_per_s > LOUD_SIGN_CHANGES_PER_S
        })
    }

    /// The figures; `None` without balancing ticks.
    #[must_use]
    pub fn figures(&self) -> Option<QuietnessFigures> {
        if self.ticks == 0 {
            return None;
        }
        let ticks = self.ticks as f64;
        Some(QuietnessFigures {
            change_v: self.changes_v / ticks,
            sign_changes_per_s: self.sign_changes as f64 / (ticks * CONTROL_PERIOD_S),
            rms_v: (self.squares_v2 / ticks).sqrt(),
            copper_loss_w: self.losses_w / ticks,
        })
    }
}

/// Copper loss I^2 R of the plant's nominal winding, W, with the current computed from voltage and
/// speed as in [`crate::safety::MotorHeat`]. The measured current is not used, because at rest it
/// is mostly the sensor's zero error.
fn copper_loss_w(voltage_v: f64, theta_dot_rad_s: f64, plant: &PlantModel) -> f64 {
    let nominal = &plant.parameters;
    let across_winding_v = voltage_v - nominal.motor_back_emf_v_s * theta_dot_rad_s;
    across_winding_v * across_winding_v / nominal.motor_resistance_ohm
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::qube::State;
    use crate::telemetry::Phase;

    /// Running ticks with these pendulum angles and voltages.
    fn rollout(
        ticks: u32,
        alpha: impl Fn(u32) -> f64,
        voltage_mv: impl Fn(u32) -> i16,
    ) -> Vec<TickRecord> {
        let tick = |tick| TickRecord {
            tick,
            phase: Phase::Running,
            state: State { alpha: alpha(tick), theta_dot: 10.0, ..State::default() },
            voltage_mv: voltage_mv(tick),
            ..TickRecord::default()
        };
        (0..ticks).map(tick).collect()
    }

    #[test]
    fn a_square_wave_has_the_figures_that_can_be_counted() {
        // The voltage is +1, +1, -1, -1 V and so on: every other tick changes by 2 V and in sign.
        let wave = |tick: u32| if tick % 4 < 2 { 1000 } else { -1000 };
        let figures =
            Quietness::of(&rollout(451, |_| -PI, wave), &PlantModel::QUBE).figures().unwrap();
        assert!((figures.change_v - 1.0).abs() < 1e-12, "{figures:?}");
        assert!((figures.sign_changes_per_s - 50.0).abs() < 1e-9, "{figures:?}");
        assert!((figures.rms_v - 1.0).abs() < 1e-12, "{figures:?}");
        // The back EMF is 0.42 V at 10 rad/s; the resistance is 8.4 ohm.
        let loss_w = (0.58 * 0.58 + 1.42 * 1.42) / 2.0 / 8.4;
        assert!((figures.copper_loss_w - loss_w).abs() < 1e-12, "{figures:?}");
        assert!(Quietness::of(&rollout(451, |_| -PI, wave), &PlantModel::QUBE).is_loud());
        let slower = |tick: u32| if tick % 20 < 10 { 1000 } else { -1000 };
        assert!(!Quietness::of(&rollout(451, |_| -PI, slower), &PlantModel::QUBE).is_loud());
        assert!(!Quietness::NONE.is_loud());
    }

    #[test]
    fn swing_up_catch_other_phases_and_a_hanging_pendulum_do_not_count() {
        let loud = |tick: u32| if tick.is_multiple_of(2) { 5000 } else { -5000 };
        assert_eq!(Quietness::of(&rollout(600, |_| 0.5, loud), &PlantModel::QUBE).figures(), None);
        // The pendulum is up at tick 100 and counts from tick 150 on.
        let alpha = |tick| if tick < 100 { 2.0 } else { PI + 0.4 };
        let quiet = |tick| if tick < 149 { loud(tick) } else { 200 };
        let mut ticks = rollout(600, alpha, quiet);
        let figures = Quietness::of(&ticks, &PlantModel::QUBE).figures().unwrap();
        assert_eq!((figures.change_v, figures.sign_changes_per_s), (0.0, 0.0));
        for tick in &mut ticks {
            tick.phase = Phase::Braking;
        }
        assert_eq!(Quietness::of(&ticks, &PlantModel::QUBE), Quietness::NONE);
    }

    #[test]
    fn rollouts_add_up_tick_by_tick_and_not_across_their_ends() {
        let still = rollout(300, |_| PI, |_| 2000);
        let first = Quietness::of(&still, &PlantModel::QUBE);
        let (mut both, mut merged) = (first, first);
        let other = rollout(150, |_| PI, |_| -2000);
        both.add(&other, &PlantModel::QUBE);
        merged.merge(&Quietness::of(&other, &PlantModel::QUBE));
        for quietness in [both, merged] {
            let figures = quietness.figures().unwrap();
            assert_eq!((figures.change_v, figures.sign_changes_per_s), (0.0, 0.0));
            assert!((figures.rms_v - 2.0).abs() < 1e-12, "{figures:?}");
        }
        assert_eq!(both.ticks, merged.ticks);
    }
}
