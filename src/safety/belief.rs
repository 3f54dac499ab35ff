use nalgebra::{DMatrix, SymmetricEigen};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::Particle;
use super::places::{NEGATIVE_SHARE, NUMBERS, PLACES, POSITIVE_SHARE};
use crate::qube::{
    CONTROL_PERIOD_S, DomainParameter, Encoder, Encoders, MAX_HISTORY, Nonidealities, Nonideality,
    ParameterError, PlantModel, Profile, Quantity, QubeModel, State,
};

/// Assumed error of an estimated velocity, rad/s: one count of the encoder in one control period.
fn velocity_error_rad_s(encoder: Encoder) -> f64 {
    encoder.rad_per_count() / CONTROL_PERIOD_S
}

/// Least relative error of an identified number whose profile names no correlations, even if its
/// standard error is smaller: no model is exact, and a healthy Qube warms up and wears. Where the
/// profile names correlations, `LEAST_MODEL_ERROR` is the least.
pub(super) const MODEL_ERROR: f64 = 0.1;

/// Least relative error of an identified number whose profile names correlations; it is added to
/// the correlated errors. With 0 and with 0.03 an independent search threw an arm into its stop
/// (SAFETY.md).
const LEAST_MODEL_ERROR: f64 = 0.05;

/// Least relative error of an identified delay, which changes with computer and link.
const DELAY_ERROR: f64 = 0.3;

/// Least absolute error of an identified delay, s.
const LEAST_DELAY_ERROR_S: f64 = 0.002;

/// Number of standard errors by which an identified number may be off.
const STANDARD_ERRORS: f64 = 3.0;

/// Number of standard errors of the step along one of the independent directions of a profile's
/// errors. Each particle takes the steps of all directions at once, so particles of a profile with
/// fourteen directions are up to 7.5 standard errors from it. With 3 in place of 2 the guard ends
/// more good rollouts (SAFETY.md).
const STEP_STANDARD_ERRORS: f64 = 2.0;

/// Largest relative error that the range of an identified parameter, or one step, may have. An
/// unidentified Qube's parameters have this error.
const UNKNOWN_SHARE: f64 = 0.3;

/// Least fraction of a voltage that is assumed to arrive at an identified Qube's motor: the supply
/// may be weak, or the amplifier may differ between the signs.
const IDENTIFIED_SHARE: f64 = 0.8;

/// A change of all numbers at once, in the order of [`Quantity::all`]: of the logarithm for
/// parameters, of the value for nonidealities.
type Step = [f64; Quantity::COUNT];

/// Assumed error of the arm's zero, rad: homing finds the middle between the stops within this
/// angle.
const ZERO_RAD: f64 = 0.02;

/// The belief about a Qube: the set of models that it may have. The set has a range for each number
/// and, optionally, is widened by steps in which several numbers change together.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Belief {
    /// Lower end of each number.
    pub low: QubeModel,
    /// Upper end of each number.
    pub high: QubeModel,
    /// Least fraction of a voltage that arrives at the motor, for either sign; below 1 if the
    /// supply may be weak, or the amplifier may differ between the signs.
    pub least_share: f64,
    /// True if the first two particles, which are the hardest to brake, get only `least_share` of a
    /// voltage whose sign brakes them. Recordings that do not name it have `false`: each of their
    /// particles got whole voltages.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub weak_side: bool,
    /// Correlated errors of a fit, as changes from any model within the ranges; all zero if they
    /// are not known.
    #[serde(default = "no_steps", skip_serializing_if = "are_none")]
    pub steps: [Step; Quantity::COUNT],
}

/// The reason why a belief is invalid.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum BeliefError {
    /// A fraction is not between 0 and 1.
    #[error("least_share = {0}: give a fraction from 0 to 1")]
    Share(f64),
    /// A parameter is not physical.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// The lower end of a number is above its upper end, or one of the two is outside the range
    /// that the number can have.
    #[error("{name} from {low} to {high}: give two possible values, the smaller one first")]
    Interval {
        /// Name of the number.
        name: &'static str,
        /// Lower end of the number.
        low: f64,
        /// Upper end of the number.
        high: f64,
    },
    /// The delay is longer than the history of commands.
    #[error("command_delay_s = {delay_s}: give at most {longest_s}")]
    Delay {
        /// The delay, s.
        delay_s: f64,
        /// The longest accepted delay, s.
        longest_s: f64,
    },
    /// A step is not a finite number, or a part of it is longer than any belief allows.
    #[error(
        "steps: give each parameter at most {UNKNOWN_SHARE}, and each nonideality at most the width of its range"
    )]
    Step,
}

fn no_steps() -> [Step; Quantity::COUNT] {
    [[0.0; Quantity::COUNT]; Quantity::COUNT]
}

fn are_none(steps: &[Step; Quantity::COUNT]) -> bool {
    *steps == no_steps()
}

impl Belief {
    /// The belief about an unidentified Qube: each parameter except gravity lies within this
    /// fraction of its nominal value. Compared with the Qube whose recordings are public, friction
    /// and cable are at most 1.6 times as strong, the delay is at most twice as long, and each dead
    /// zone is at most slightly wider than that Qube's wider one. The whole of a voltage arrives at
    /// the motor.
    #[must_use]
    pub fn of_any_qube(within: f64) -> Self {
        Self::of_any_plant(&PlantModel::QUBE, within)
    }

    /// The belief about a plant of which only the description is known: each parameter except
    /// gravity lies within this fraction of its nominal value. The nonidealities have the ranges of
    /// [`Self::of_any_qube`]; the ranges of Coulomb friction and of the cable's stiffness are
    /// scaled in the proportion of the two motors' torques.
    #[must_use]
    pub fn of_any_plant(plant: &PlantModel, within: f64) -> Self {
        let (mut low, mut high) = (plant.nominal(), plant.nominal());
        for parameter in DomainParameter::ALL {
            if parameter != DomainParameter::Gravity {
                let nominal = plant.parameters.get(parameter);
                low.parameters.set(parameter, (1.0 - within) * nominal);
                high.parameters.set(parameter, ((1.0 + within) * nominal).min(parameter.largest()));
            }
        }
        low.nonidealities = Nonidealities { cable_rest_rad: -1.2, ..Nonidealities::default() };
        let torques = plant.torque_per_qube_torque();
        high.nonidealities = Nonidealities {
            coulomb_torque_n_m: torques * 7e-4,
            positive_dead_zone_v: 0.35,
            negative_dead_zone_v: 0.35,
            cable_stiffness_n_m_rad: torques * 1.4e-3,
            cable_rest_rad: 1.2,
            command_delay_s: 0.02,
            ..Nonidealities::default()
        };
        for term in Nonideality::ALL {
            high.set(term.into(), possible(term, high.get(term.into())));
        }
        Self { low, high, least_share: 1.0, weak_side: false, steps: no_steps() }
    }

    /// The belief about a specimen of this plant, from its profile. Each number except gravity may
    /// be off by three standard errors or by 10 %, whichever is larger; a parameter may be off by
    /// at most 30 %, and the delay by at least 30 % and at least 2 ms. At least 80 % of a voltage
    /// arrives at the motor; only the first two particles get so little, and each for one sign
    /// only.
    ///
    /// If the profile has correlations, steps of two standard errors in the independent directions
    /// of the errors take the place of the three standard errors of each number. Besides, each
    /// number may be off by 10 % minus its three standard errors, but by at least 5 %.
    #[must_use]
    pub fn of_profile(profile: &Profile, plant: &PlantModel) -> Self {
        let model = profile.model();
        let mut belief = Self {
            low: model,
            high: model,
            least_share: IDENTIFIED_SHARE,
            weak_side: true,
            steps: independent_steps(profile, plant),
        };
        for quantity in Quantity::all() {
            let value = model.get(quantity);
            let error = STANDARD_ERRORS * profile.standard_error(quantity);
            let model_error = MODEL_ERROR * value.abs();
            let error = if profile.correlations.is_some() {
                (model_error - error).max(LEAST_MODEL_ERROR * value.abs())
            } else {
                error.max(model_error)
            };
            let off = match quantity {
                Quantity::Parameter(DomainParameter::Gravity) => 0.0,
                Quantity::Parameter(_) => error.min(UNKNOWN_SHARE * value),
                Quantity::Nonideality(Nonideality::CommandDelay) => {
                    error.max(DELAY_ERROR * value).max(LEAST_DELAY_ERROR_S)
                }
                Quantity::Nonideality(_) => error,
            };
            belief.widen(quantity, off);
        }
        belief
    }

    /// Widens this belief so that each parameter except gravity, and each nonideality except the
    /// delay, may be off by at least this fraction of the middle of its range.
    #[must_use]
    pub fn at_least_within(mut self, fraction: f64) -> Self {
        for quantity in Quantity::all() {
            if quantity != Quantity::Parameter(DomainParameter::Gravity)
                && quantity != Quantity::Nonideality(Nonideality::CommandDelay)
            {
                let [low, high] = [self.low, self.high].map(|end| end.get(quantity));
                let lacking = fraction * (0.5 * (low + high)).abs() - 0.5 * (high - low);
                self.widen(quantity, lacking.max(0.0));
            }
        }
        self
    }

    /// Moves both ends of a number outward; a nonideality stays within its range, and a parameter
    /// at or below its largest value.
    fn widen(&mut self, quantity: Quantity, off: f64) {
        let (low, high) = (self.low.get(quantity) - off, self.high.get(quantity) + off);
        let (low, high) = match quantity {
            Quantity::Parameter(parameter) => (low, high.min(parameter.largest())),
            Quantity::Nonideality(term) => (possible(term, low), possible(term, high)),
        };
        self.low.set(quantity, low);
        self.high.set(quantity, high);
    }

    /// Returns this belief for a link whose samples may be up to `age_s` seconds older than they
    /// seem. A command's delay counts from its sample, so the longest delay grows by this age, up
    /// to the longest that a belief may have.
    #[must_use]
    pub fn with_sample_age(mut self, age_s: f64) -> Self {
        let delay_s = self.high.nonidealities.command_delay_s + age_s;
        self.high.nonidealities.command_delay_s = delay_s.min(LONGEST_DELAY_S);
        self
    }

    /// Checks that the two ends and the steps describe Qubes.
    ///
    /// # Errors
    /// The first number that is wrong.
    pub(super) fn check(&self) -> Result<(), BeliefError> {
        if !(0.0..=1.0).contains(&self.least_share) {
            return Err(BeliefError::Share(self.least_share));
        }
        for end in [self.low, self.high] {
            end.parameters.check()?;
        }
        for quantity in Quantity::all() {
            let [low, high] = [self.low, self.high].map(|end| end.get(quantity));
            let range = match quantity {
                Quantity::Parameter(_) => 0.0..=f64::MAX,
                Quantity::Nonideality(term) => term.range(),
            };
            if !(range.contains(&low) && range.contains(&high) && low <= high) {
                return Err(BeliefError::Interval { name: quantity.name(), low, high });
            }
        }
        let longest_s = LONGEST_DELAY_S;
        let delay_s = self.high.nonidealities.command_delay_s;
        if delay_s > longest_s {
            return Err(BeliefError::Delay { delay_s, longest_s });
        }
        let within = |(part, quantity): (&f64, Quantity)| {
            let longest = match quantity {
                Quantity::Parameter(_) => UNKNOWN_SHARE,
                Quantity::Nonideality(term) => term.range().end() - term.range().start(),
            };
            part.abs() <= longest * (1.0 + 1e-9)
        };
        if !self.steps.iter().all(|step| step.iter().zip(Quantity::all()).all(within)) {
            return Err(BeliefError::Step);
        }
        Ok(())
    }

    /// The particles of this belief, with the hardest to brake first. The encoders determine the
    /// assumed errors of the estimated velocities.
    #[must_use]
    pub fn particles(&self, encoders: Encoders) -> Vec<Particle> {
        let arm_rad_s = velocity_error_rad_s(encoders.theta);
        let pendulum_rad_s = velocity_error_rad_s(encoders.alpha);
        // The widths of a Qube serve for every plant, because they only decide to which side a
        // particle takes a step.
        let widths = unknown_widths(&PlantModel::QUBE);
        let share = |place: &[i8; NUMBERS]| place.map(|percent| f64::from(percent) / 100.0);
        let places = PLACES.iter().map(share).enumerate();
        let both = places.flat_map(|(row, mut place)| {
            if self.weak_side && row == 0 {
                // This particle's arm moves towards positive angles, so negative voltages brake it.
                place[NEGATIVE_SHARE] = -1.0;
            }
            // In every other pair of particles the pendulum's velocity error has the opposite sign
            // of the arm's.
            let swing_rad_s = if row % 2 == 0 { pendulum_rad_s } else { -pendulum_rad_s };
            let error = State {
                theta: ZERO_RAD,
                theta_dot: arm_rad_s,
                alpha_dot: swing_rad_s,
                ..State::default()
            };
            let mirrored_error = State {
                theta: -ZERO_RAD,
                theta_dot: -arm_rad_s,
                alpha_dot: -swing_rad_s,
                ..State::default()
            };
            [
                Particle { error, ..self.at(&place, &widths) },
                Particle { error: mirrored_error, ..self.at(&mirrored(&place), &widths) },
            ]
        });
        both.collect()
    }

    /// The particle at these coordinates, each from -1 (lower end) to 1 (upper end).
    fn at(&self, place: &[f64; NUMBERS], widths: &Step) -> Particle {
        let between = |low: f64, high: f64, place: f64| 0.5 * (low + high + place * (high - low));
        let mut model = QubeModel { nonidealities: Nonidealities::default(), ..self.low };
        for (quantity, place) in Quantity::all().zip(place) {
            let [low, high] = [self.low, self.high].map(|end| end.get(quantity));
            model.set(quantity, between(low, high, *place));
        }
        for step in &self.steps {
            take_step(&mut model, step, place, widths);
        }
        Particle {
            model,
            positive_share: between(self.least_share, 1.0, place[POSITIVE_SHARE]),
            negative_share: between(self.least_share, 1.0, place[NEGATIVE_SHARE]),
            error: State::default(),
        }
    }
}

/// Longest delay of a particle, s.
const LONGEST_DELAY_S: f64 = MAX_HISTORY as f64 * CONTROL_PERIOD_S;

/// The value nearest to this one that a particle's nonideality may have.
fn possible(term: Nonideality, value: f64) -> f64 {
    let (least, most) = term.range().into_inner();
    value.clamp(least, if term == Nonideality::CommandDelay { LONGEST_DELAY_S } else { most })
}

/// Half-width of each number's range for an unidentified specimen of a plant: relative for
/// parameters, in the number's own unit for nonidealities.
fn unknown_widths(plant: &PlantModel) -> Step {
    let Belief { low, high, .. } = Belief::of_any_plant(plant, UNKNOWN_SHARE);
    let mut widths = [UNKNOWN_SHARE; Quantity::COUNT];
    for term in Nonideality::ALL {
        widths[Quantity::Nonideality(term).index()] =
            0.5 * (high.nonidealities.get(term) - low.nonidealities.get(term));
    }
    widths
}

/// Moves a Qube by one step, forwards or backwards: to the side on which the coordinates lie.
fn take_step(model: &mut QubeModel, step: &Step, place: &[f64; NUMBERS], widths: &Step) {
    let parts = step.iter().zip(widths).zip(place);
    let along: f64 = parts.map(|((step, width), place)| step / width * place).sum();
    for (quantity, step) in Quantity::all().zip(step) {
        let step = if along < 0.0 { -step } else { *step };
        let value = model.get(quantity);
        model.set(
            quantity,
            match quantity {
                Quantity::Parameter(_) => value * step.exp(),
                Quantity::Nonideality(term) => possible(term, value + step),
            },
        );
    }
}

/// Two standard errors of a profile in each independent direction of its errors; all zero without
/// correlations. The recordings leave one direction undetermined: all masses and forces may grow by
/// the same factor without a change in any motion. Therefore no step changes a number by more than
/// the uncertainty about an unidentified specimen of the plant.
fn independent_steps(profile: &Profile, plant: &PlantModel) -> [Step; Quantity::COUNT] {
    let Some(correlations) = &profile.correlations else { return no_steps() };
    let quantities: Vec<Quantity> = Quantity::all().collect();
    let (model, widths) = (profile.model(), unknown_widths(plant));
    // In units of the uncertainty about an unidentified specimen.
    let error = |quantity: Quantity| {
        let value = match quantity {
            Quantity::Parameter(_) => model.get(quantity),
            Quantity::Nonideality(_) => 1.0,
        };
        if value == 0.0 {
            return 0.0;
        }
        profile.standard_error(quantity) / value / widths[quantity.index()]
    };
    let covariance = DMatrix::from_fn(quantities.len(), quantities.len(), |row, column| {
        let (one, other) = (quantities[row], quantities[column]);
        correlations.of(one, other) * error(one) * error(other)
    });
    let eigen = SymmetricEigen::new(covariance);
    let mut steps = no_steps();
    for (index, step) in steps.iter_mut().enumerate() {
        let length = STEP_STANDARD_ERRORS * eigen.eigenvalues[index].max(0.0).sqrt();
        let direction = eigen.eigenvectors.column(index);
        let longest = length * direction.amax();
        let shortened = if longest > 1.0 { length / longest } else { length };
        for (part, (step, width)) in direction.iter().zip(step.iter_mut().zip(&widths)) {
            *step = shortened * part * width;
        }
    }
    steps
}

/// The coordinates of the mirror image, in which positive and negative directions are exchanged.
fn mirrored(place: &[f64; NUMBERS]) -> [f64; NUMBERS] {
    let mut other = *place;
    other.swap(POSITIVE_SHARE, NEGATIVE_SHARE);
    for (quantity, coordinate) in Quantity::all().zip(place) {
        let (image, sign) = mirror_image(quantity);
        other[image.index()] = sign * coordinate;
    }
    other
}

/// The quantity whose place a quantity takes in the mirror image, and the sign of its value there.
fn mirror_image(quantity: Quantity) -> (Quantity, f64) {
    match quantity {
        Quantity::Nonideality(Nonideality::PositiveDeadZone) => {
            (Nonideality::NegativeDeadZone.into(), 1.0)
        }
        Quantity::Nonideality(Nonideality::NegativeDeadZone) => {
            (Nonideality::PositiveDeadZone.into(), 1.0)
        }
        Quantity::Nonideality(Nonideality::CableRest) => (quantity, -1.0),
        Quantity::Parameter(_)
        | Quantity::Nonideality(
            Nonideality::CoulombTorque | Nonideality::CableStiffness | Nonideality::CommandDelay,
        ) => (quantity, 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::Correlations;

    fn belief_of(profile: &Profile) -> Belief {
        Belief::of_profile(profile, &PlantModel::QUBE)
    }

    /// Half the width of a number's range, relative to its value in the profile `lab`.
    fn half_width(belief: &Belief, name: &str) -> f64 {
        let quantity = Quantity::from_name(name).unwrap();
        let width = belief.high.get(quantity) - belief.low.get(quantity);
        0.5 * width / Profile::lab().model().get(quantity)
    }

    fn is(value: f64, expected: f64) -> bool {
        (value - expected).abs() < 1e-9
    }

    #[test]
    fn a_mirror_image_exchanges_the_directions_and_keeps_all_else() {
        let place: [f64; NUMBERS] = std::array::from_fn(|index| 1.0 + index as f64);
        let image = mirrored(&place);
        assert_eq!(mirrored(&image), place);
        let moved: Vec<usize> = (0..NUMBERS).filter(|it| image[*it] != place[*it]).collect();
        assert_eq!(moved, [10, 11, 13, 15, 16]);
        let rest = Quantity::from(Nonideality::CableRest).index();
        assert_eq!((rest, image[rest]), (13, -place[rest]));
    }

    #[test]
    fn a_belief_is_as_wide_as_its_profiles_errors_and_ten_percent() {
        let lab = Profile::lab();
        let apart = Profile { correlations: None, ..lab.clone() };
        let exact = belief_of(&Profile::exact("exact", &lab.model()));
        let (correlated, apart) = (belief_of(&lab), belief_of(&apart));
        assert_ne!(correlated.steps, no_steps());
        // Three standard errors of the resistance are 65 %, and of the pendulum's length 1.9 %.
        let length = 3.0 * lab.standard_errors["L_p"] / lab.parameters.pendulum_length_m;
        assert!(is(half_width(&correlated, "R_m"), LEAST_MODEL_ERROR));
        assert!(is(half_width(&correlated, "L_p"), 0.1 - length));
        assert!(is(half_width(&apart, "R_m"), 0.3) && is(half_width(&apart, "L_p"), 0.1));
        assert!(is(half_width(&exact, "R_m"), 0.1) && is(half_width(&exact, "L_p"), 0.1));
        for belief in [correlated, apart, exact] {
            assert!(is(half_width(&belief, "command_delay_s"), 0.3));
            assert_eq!(belief.check(), Ok(()));
            assert_eq!(belief.at_least_within(0.0), belief, "a tolerance of 0 changes nothing");
            let tolerated = belief.at_least_within(0.1);
            assert_eq!(tolerated.check(), Ok(()));
            assert!(half_width(&tolerated, "R_m") > 0.1 - 1e-9);
        }
    }

    #[test]
    fn the_hardest_particles_of_an_identified_qube_have_a_weak_side() {
        let belief = belief_of(&Profile::lab());
        let shares = |belief: &Belief| -> Vec<[f64; 2]> {
            let particles = belief.particles(PlantModel::QUBE.encoders);
            particles.iter().map(|it| [it.positive_share, it.negative_share]).collect()
        };
        let mut whole = vec![[1.0, 1.0]; 64];
        let mut earlier = serde_json::to_value(belief).unwrap();
        earlier.as_object_mut().unwrap().remove("weak_side").unwrap();
        assert_eq!(shares(&serde_json::from_value(earlier).unwrap()), whole);
        whole[..2].copy_from_slice(&[[1.0, IDENTIFIED_SHARE], [IDENTIFIED_SHARE, 1.0]]);
        assert_eq!(shares(&belief), whole);
    }

    #[test]
    fn a_number_given_to_the_identification_may_be_off_by_ten_percent() {
        let mut fixed = Profile::lab();
        fixed.standard_errors.remove("R_m");
        assert!(is(half_width(&belief_of(&fixed), "R_m"), 0.1));
    }

    #[test]
    fn a_profile_that_leaves_a_number_undetermined_gives_a_belief_that_reads_back() {
        let names = Quantity::all().map(|quantity| quantity.name().to_owned()).collect();
        let one = |row: usize| {
            (0..Quantity::COUNT).map(|column| f64::from(u8::from(row == column))).collect()
        };
        let matrix: Vec<Vec<f64>> = (0..Quantity::COUNT).map(one).collect();
        let correlations = Some(Correlations::new(names, &matrix));
        let exact = Profile::exact("ideal", &QubeModel::NOMINAL);
        let undetermined = Profile { correlations, ..exact };
        for quantity in Quantity::all() {
            // This error is far beyond the range in the belief about any Qube.
            let errors = [(quantity.name().to_owned(), 100.0)].into();
            let profile = Profile { standard_errors: errors, ..undetermined.clone() };
            let belief = belief_of(&profile);
            assert_eq!(belief.check(), Ok(()), "{quantity:?}");
            let written = serde_json::to_string(&belief).unwrap();
            assert_eq!(serde_json::from_str::<Belief>(&written).unwrap(), belief);
        }
        let mut farther = belief_of(&undetermined);
        farther.steps[0][0] = 2.0 * UNKNOWN_SHARE;
        assert_eq!(farther.check(), Err(BeliefError::Step));
    }

    #[test]
    fn the_belief_about_a_plant_at_the_end_of_its_range_can_be_recorded() {
        let mut plant = PlantModel::QUBE;
        for parameter in DomainParameter::ALL {
            plant.parameters.set(parameter, 0.9 * parameter.largest());
        }
        assert_eq!(Belief::of_any_plant(&plant, UNKNOWN_SHARE).check(), Ok(()));
        let profile = Profile::exact("exact", &plant.nominal());
        assert_eq!(Belief::of_profile(&profile, &plant).check(), Ok(()));
    }

    #[test]
    fn the_steps_of_a_plant_with_a_stronger_motor_are_as_long_as_its_errors() {
        let mut plant = PlantModel::QUBE;
        plant.parameters.motor_back_emf_v_s *= 3.0;
        let friction = Quantity::Nonideality(Nonideality::CoulombTorque);
        let mut model = Profile::lab().model();
        model.parameters.motor_back_emf_v_s *= 3.0;
        model.nonidealities.coulomb_torque_n_m *= 3.0;
        let error_n_m = 4e-4;
        let profile = Profile {
            standard_errors: [(friction.name().to_owned(), error_n_m)].into(),
            correlations: Some(Correlations::new(vec![friction.name().to_owned()], &[vec![1.0]])),
            ..Profile::exact("strong", &model)
        };
        let longest_n_m = |plant: &PlantModel| {
            let belief = Belief::of_profile(&profile, plant);
            assert_eq!(belief.check(), Ok(()));
            belief.steps.iter().map(|step| step[friction.index()].abs()).fold(0.0, f64::max)
        };
        assert!(is(longest_n_m(&plant), STEP_STANDARD_ERRORS * error_n_m));
        assert!(
            is(longest_n_m(&PlantModel::QUBE), 3.5e-4),
            "no step exceeds the uncertainty about any Qube"
        );
    }
}
