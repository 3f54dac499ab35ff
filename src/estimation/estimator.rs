use std::f64::consts::PI;

use super::observer::Observer;
use super::{Calibration, EstimatorSettings, FilterGains, through_filters};
use crate::qube::{Measurement, State, wrap_angle};

/// Estimator of the state from encoder samples at times of the device's clock.
#[derive(Clone, Copy, Debug)]
pub struct Estimator {
    settings: EstimatorSettings,
    calibration: Calibration,
    observer: Option<Observer>,
    previous: Option<Previous>,
}

/// Estimates of the state after the samples so far.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Estimates {
    /// State for policy and reward, by the filter or observer of the settings.
    pub seen: State,
    /// State for the guard and for homing, settling and braking the arm. A filter without a model
    /// gives this state, with a corner of at least [`super::GUARD_CORNER_RAD_S`], so that no wrong
    /// model can falsify it.
    pub guarded: State,
}

#[derive(Clone, Copy, Debug)]
struct Previous {
    device_time_us: u64,
    estimates: Estimates,
}

impl Estimator {
    /// An estimator that assumes rest at the first measurement: its estimates there have the
    /// velocities 0.
    #[must_use]
    pub fn new(settings: EstimatorSettings, calibration: Calibration) -> Self {
        Self { settings, calibration, observer: None, previous: None }
    }

    /// Takes one more measurement and returns the estimates. A measurement no newer than the last
    /// changes nothing.
    pub fn update(&mut self, measurement: &Measurement) -> Estimates {
        let (theta, alpha) = self.calibration.angles_rad(measurement);
        let now_us = measurement.device_time_us;
        let estimates = match self.previous {
            None => {
                let at_rest = State { theta, alpha, ..State::default() };
                let encoders = self.calibration.encoders;
                self.observer = self
                    .settings
                    .observer
                    .as_ref()
                    .map(|own| Observer::new(own, encoders, at_rest));
                Estimates { seen: at_rest, guarded: at_rest }
            }
            Some(Previous { device_time_us: before_us, estimates }) if now_us > before_us => {
                let elapsed_s = (now_us - before_us) as f64 * 1e-6;
                let filtered = |state: &State, corner_rad_s| {
                    let gains = FilterGains::new(corner_rad_s, elapsed_s);
                    through_filters(state, theta, alpha, &gains)
                };
                let guarded = filtered(&estimates.guarded, self.settings.guard_corner_rad_s());
                let seen = match &mut self.observer {
                    Some(observer) => observer.update(before_us, now_us, &guarded),
                    None if self.settings.policy_sees_as_guard() => guarded,
                    None => filtered(&estimates.seen, self.settings.corner_rad_s),
                };
                Estimates { seen, guarded }
            }
            Some(Previous { estimates, .. }) => return estimates,
        };
        self.previous = Some(Previous { device_time_us: now_us, estimates });
        estimates
    }

    /// Records the voltage that was sent in answer to the last measurement, V, for the observer's
    /// prediction; does nothing without an observer or before the first measurement.
    pub fn send(&mut self, voltage_v: f64) {
        if let (Some(observer), Some(previous)) = (&mut self.observer, &self.previous) {
            observer.send(previous.device_time_us, voltage_v);
        }
    }

    /// Removes the pendulum's whole turns so that alpha lies in (-pi, pi], and returns the
    /// estimates after the shift. Velocities are kept. Before the first measurement it changes
    /// nothing and returns zeros.
    pub fn forget_whole_turns(&mut self) -> Estimates {
        let Some(Previous { estimates, .. }) = &mut self.previous else {
            return Estimates::default();
        };
        let alpha = estimates.guarded.alpha;
        let turns = ((alpha - wrap_angle(alpha)) / (2.0 * PI)).round();
        let turns = turns as i32;
        let encoder = self.calibration.encoders.alpha;
        self.calibration = self.calibration.with_alpha_zero_turned(turns);
        // The previous angle moves with the zero, so that the next difference has no jump.
        let by_rad = -encoder.angle_rad(turns * encoder.counts_per_revolution());
        estimates.guarded.alpha += by_rad;
        estimates.seen.alpha += by_rad;
        if let Some(observer) = &mut self.observer {
            observer.shift_alpha(by_rad);
        }
        *estimates
    }

    /// Number of times that the observer was reset to encoders and filter, because it had diverged
    /// or too long an interval had passed without a sample; 0 without an observer.
    #[must_use]
    pub fn observer_resets(&self) -> u32 {
        self.observer.as_ref().map_or(0, Observer::observer_resets)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{ObserverSettings, SentVoltages};
    use super::*;
    use crate::qube::COUNTS_PER_REVOLUTION;
    use crate::qube::{
        DomainParameters, NonidealDynamics, Nonidealities, QubeModel, counts, runge_kutta_4,
    };

    #[test]
    fn counts_of_a_steady_turn_become_its_velocity_within_one_count_of_noise() {
        let calibration =
            Calibration { theta_zero_counts: -500, alpha_inverted: true, ..Calibration::IDENTITY };
        let mut estimator = Estimator::new(EstimatorSettings::default(), calibration);
        let mut state = State::default();
        for step in 0..100_u64 {
            let time_s = step as f64 * 0.01;
            let estimates = estimator.update(&Measurement {
                device_time_us: step * 10_000,
                theta_counts: counts(2.0 * time_s) - 500,
                alpha_counts: counts(-5.0 * time_s),
                ..Measurement::default()
            });
            assert_eq!(estimates.seen, estimates.guarded);
            state = estimates.seen;
        }
        assert!((state.theta - 1.98).abs() < 0.004, "{state:?}");
        assert!((state.alpha - 4.95).abs() < 0.004, "{state:?}");
        assert!((state.theta_dot - 2.0).abs() < 0.31, "{state:?}");
        assert!((state.alpha_dot - 5.0).abs() < 0.31, "{state:?}");
    }

    #[test]
    fn forgetting_whole_turns_moves_alpha_and_nothing_else() {
        let observer = EstimatorSettings::observer(ObserverSettings::default());
        for (alpha_inverted, settings) in [
            (false, EstimatorSettings::filter(50.0)),
            (true, EstimatorSettings::default()),
            (true, observer),
        ] {
            let calibration = Calibration { alpha_inverted, ..Calibration::IDENTITY };
            let mut estimator = Estimator::new(settings, calibration);
            let at = |tick: u64| Measurement {
                device_time_us: tick * 10_000,
                alpha_counts: 3 * COUNTS_PER_REVOLUTION + 7 + tick as i32,
                ..Measurement::default()
            };
            let mut undisturbed = estimator;
            undisturbed.update(&at(0));
            undisturbed.update(&at(1));
            estimator.update(&at(0));
            let before = estimator.update(&at(1));
            let after = estimator.forget_whole_turns();
            let (next, expected) = (estimator.update(&at(2)), undisturbed.update(&at(2)));
            for of in [|both: &Estimates| both.seen, |both: &Estimates| both.guarded] {
                let (before, after) = (of(&before), of(&after));
                assert!((after.alpha - wrap_angle(before.alpha)).abs() < 1e-9);
                assert_eq!(after.alpha_dot, before.alpha_dot);
                let (next, expected) = (of(&next), of(&expected));
                assert!((next.alpha - wrap_angle(expected.alpha)).abs() < 1e-9);
                assert!((next.alpha_dot - expected.alpha_dot).abs() < 1e-9);
            }
        }
    }

    /// The plant of a test, advanced to its last sample.
    struct TestPlant {
        sent: SentVoltages,
        state: State,
        now_us: u64,
    }

    impl TestPlant {
        fn new(model: &QubeModel) -> Self {
            let sent = SentVoltages::new(model.nonidealities.command_delay_s, 0.0);
            Self { sent, state: State { theta: 0.2, alpha: 0.1, ..State::default() }, now_us: 0 }
        }

        /// The state some time after the last sample, integrated with much finer steps than the
        /// observer's.
        fn at(&self, model: &QubeModel, until_us: u64) -> State {
            let dynamics = NonidealDynamics::<f64>::new(model);
            let mut state = self.state;
            for piece in self.sent.between(self.now_us, until_us) {
                for _ in 0..20 {
                    let step_s = piece.duration_us as f64 * 1e-6 / 20.0;
                    state = runge_kutta_4(&dynamics, state, piece.voltage, step_s);
                }
            }
            state
        }

        fn sample(&self) -> Measurement {
            Measurement {
                device_time_us: self.now_us,
                theta_counts: counts(self.state.theta),
                alpha_counts: counts(self.state.alpha),
                ..Measurement::default()
            }
        }
    }

    fn real() -> QubeModel {
        QubeModel {
            parameters: DomainParameters { motor_resistance_ohm: 9.1, ..DomainParameters::NOMINAL },
            nonidealities: Nonidealities {
                coulomb_torque_n_m: 4e-4,
                cable_stiffness_n_m_rad: 9e-4,
                command_delay_s: 0.0134,
                ..Nonidealities::default()
            },
        }
    }

    /// Root mean square errors of both velocities over 3 s of swinging, against the true state at
    /// the instant at which the command acts.
    fn velocity_errors(settings: EstimatorSettings, ahead_us: u64) -> (f64, f64) {
        let model = real();
        let mut plant = TestPlant::new(&model);
        let mut estimator = Estimator::new(settings, Calibration::IDENTITY);
        let (mut theta, mut alpha, mut samples) = (0.0, 0.0, 0.0);
        for tick in 0..300_u64 {
            // Every ninth sample is lost together with its command.
            if tick % 9 == 4 {
                continue;
            }
            let now_us = tick * 10_000;
            plant.state = plant.at(&model, now_us);
            plant.now_us = now_us;
            let Estimates { seen, .. } = estimator.update(&plant.sample());
            let later = plant.at(&model, now_us + ahead_us);
            theta += (seen.theta_dot - later.theta_dot).powi(2);
            alpha += (seen.alpha_dot - later.alpha_dot).powi(2);
            samples += 1.0;
            let voltage_v = 3.0 * (0.13 * tick as f64).sin().signum();
            estimator.send(voltage_v);
            plant.sent.send(now_us, voltage_v);
        }
        ((theta / samples).sqrt(), (alpha / samples).sqrt())
    }

    #[test]
    fn an_observer_of_the_right_qube_predicts_the_velocities_at_the_instant_of_the_command() {
        let observer = EstimatorSettings::observer(ObserverSettings::of(real()));
        let (theta, alpha) = velocity_errors(observer, 13_400);
        println!("observer {theta} {alpha}");
        assert!(theta < 0.15 && alpha < 0.15, "{theta} {alpha}");
        let (theta, alpha) = velocity_errors(EstimatorSettings::default(), 13_400);
        println!("filter {theta} {alpha}");
        assert!(theta > 0.5 && alpha > 0.5, "{theta} {alpha}");
    }

    #[test]
    fn the_guard_sees_the_fast_filter_whatever_the_policy_sees() {
        let nonsense = QubeModel {
            nonidealities: Nonidealities {
                cable_stiffness_n_m_rad: -1e6,
                ..Nonidealities::default()
            },
            ..QubeModel::NOMINAL
        };
        let mut plain = Estimator::new(EstimatorSettings::default(), Calibration::IDENTITY);
        let mut others = [
            EstimatorSettings::filter(50.0),
            EstimatorSettings::observer(ObserverSettings::of(real())),
            EstimatorSettings::observer(ObserverSettings::of(nonsense)),
        ]
        .map(|settings| Estimator::new(settings, Calibration::IDENTITY));
        let model = real();
        let mut plant = TestPlant::new(&model);
        for tick in 0..200_u64 {
            plant.state = plant.at(&model, tick * 10_000);
            plant.now_us = tick * 10_000;
            let voltage_v = 4.0 * (0.1 * tick as f64).sin();
            plant.sent.send(plant.now_us, voltage_v);
            let expected = plain.update(&plant.sample());
            for other in &mut others {
                let estimates = other.update(&plant.sample());
                assert_eq!(estimates.guarded, expected.guarded);
                assert!(tick < 5 || estimates.seen != expected.seen || other.observer_resets() > 0);
                assert!(estimates.seen.is_finite());
                other.send(voltage_v);
            }
        }
    }

    #[test]
    fn a_diverged_observer_restarts_from_encoders_and_filter_and_counts_the_reset() {
        let settings = EstimatorSettings::observer(ObserverSettings::default());
        let mut estimator = Estimator::new(settings, Calibration::IDENTITY);
        let at = |tick: u64, theta_counts| Measurement {
            device_time_us: tick * 10_000,
            theta_counts,
            ..Measurement::default()
        };
        for tick in 0..20 {
            estimator.update(&at(tick, 0));
        }
        assert_eq!(estimator.observer_resets(), 0);
        // A hand has turned the arm by a tenth of a turn.
        let estimates = estimator.update(&at(20, 205));
        assert_eq!((estimates.seen, estimator.observer_resets()), (estimates.guarded, 1));
        // The link is silent for longer than the observer predicts over.
        for tick in 21..60 {
            estimator.update(&at(tick, 205));
        }
        let before = estimator.observer_resets();
        let estimates = estimator.update(&at(71, 206));
        assert_eq!((estimates.seen, estimator.observer_resets()), (estimates.guarded, before + 1));
    }

    #[test]
    fn an_old_measurement_changes_nothing() {
        let mut estimator = Estimator::new(EstimatorSettings::default(), Calibration::IDENTITY);
        let at = |device_time_us, theta_counts| Measurement {
            device_time_us,
            theta_counts,
            ..Measurement::default()
        };
        estimator.update(&at(0, 0));
        let estimates = estimator.update(&at(10_000, 5));
        assert_eq!(estimator.update(&at(10_000, 90)), estimates);
        assert_eq!(estimator.update(&at(5_000, 90)), estimates);
    }
}
