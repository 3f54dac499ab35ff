use super::foresight::Prediction;
use super::{CentringBrake, Contradiction, Foreseen, ForeseenAngle, Foresight};
use crate::elementary::Level;
use crate::qube::{MAX_HISTORY, State};

/// Foresight that uses the belief about an identified Qube as long as the Qube moves accordingly,
/// and the belief about any Qube otherwise.
///
/// A profile must earn trust again in each rollout. The arm settles under the belief about any
/// Qube. If the profile predicts the whole of that motion, the policy runs under the belief from
/// the profile. A single sample with an angle that lies farther outside the range of the predicted
/// angles than allowed ends the trust.
#[derive(Clone, Debug)]
pub struct TrustedForesight {
    any: Foresight<CentringBrake>,
    identified: Option<Identified>,
    /// Prediction for the last voltage that was examined; `None` before the first.
    angle: Option<ForeseenAngle>,
}

#[derive(Clone, Debug)]
struct Identified {
    foresight: Foresight<CentringBrake>,
    prediction: Prediction,
    trust: Trust,
}

/// Trust in the belief about an identified Qube.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trust {
    /// The belief has predicted every motion so far; the belief about any Qube decides.
    Untested,
    /// The belief decides.
    Earned,
    /// A motion has contradicted the belief; the belief about any Qube decides.
    Lost,
}

impl TrustedForesight {
    /// Foresight for any Qube, and, if there is a profile, for the identified one with the
    /// prediction that must follow its motion.
    #[must_use]
    pub fn new(
        any: Foresight<CentringBrake>,
        identified: Option<(Foresight<CentringBrake>, Prediction)>,
    ) -> Self {
        let identified = identified.map(|(foresight, prediction)| Identified {
            foresight,
            prediction,
            trust: Trust::Untested,
        });
        Self { any, identified, angle: None }
    }

    /// Selects the instruction set, for comparisons.
    #[must_use]
    pub fn at_level(self, level: Level) -> Self {
        let identified = self.identified.map(|Identified { foresight, prediction, trust }| {
            let foresight = foresight.at_level(level);
            Identified { foresight, prediction: prediction.at_level(level), trust }
        });
        Self { any: self.any.at_level(level), identified, angle: self.angle }
    }

    /// Sets the number of control periods between the last two samples for both beliefs;
    /// [`Foresight::sampled_after`] explains the effect.
    pub fn sampled_after(&mut self, periods: u32) {
        self.any.sampled_after(periods);
        if let Some(Identified { foresight, prediction, .. }) = &mut self.identified {
            foresight.sampled_after(periods);
            prediction.sampled_after(periods);
        }
    }

    /// Assumes that the velocities of the last sample are as exact as without lost samples, in the
    /// foresight of both beliefs; the prediction beside the Qube does not assume it.
    pub fn trust_velocities(&mut self) {
        self.any.trust_velocities();
        if let Some(Identified { foresight, .. }) = &mut self.identified {
            foresight.trust_velocities();
        }
    }

    /// Returns the contradiction between a sample and the profile while the belief from the profile
    /// decides. Takes the sample's estimated state and device time, us, and the commands before it
    /// (V, newest first).
    ///
    /// A sample that contradicts the profile always ends the trust, but while the arm settles the
    /// other belief decides, and this method then returns `None`.
    #[must_use]
    pub fn contradiction(
        &mut self,
        state: &State,
        device_time_us: u64,
        sent_v: &[f32; MAX_HISTORY],
    ) -> Option<Contradiction> {
        let Identified { prediction, trust, .. } =
            self.identified.as_mut().filter(|identified| identified.trust != Trust::Lost)?;
        let contradiction = prediction.contradiction(state, device_time_us, sent_v)?;
        let decided = *trust == Trust::Earned;
        *trust = Trust::Lost;
        decided.then_some(contradiction)
    }

    /// Starts the policy: the belief about the identified Qube decides from here on, if it has
    /// predicted the whole settling. The prediction restarts, because the angles may be counted
    /// from a new zero.
    pub fn begin_policy(&mut self) {
        if let Some(Identified { prediction, trust, .. }) = &mut self.identified {
            prediction.begin_anew();
            if *trust == Trust::Untested {
                *trust = Trust::Earned;
            }
        }
    }

    /// The particle of the deciding belief that the brake would stop too late after this voltage;
    /// `None` if there is no such particle. [`Foresight::predict`] explains the arguments.
    #[must_use]
    pub fn too_late_for(
        &mut self,
        state: &State<f32>,
        sent_v: &[f32; MAX_HISTORY],
        voltage_v: f32,
    ) -> Option<Foreseen> {
        let (foresight, identified) = match &mut self.identified {
            Some(Identified { foresight, trust: Trust::Earned, .. }) => (foresight, true),
            _ => (&mut self.any, false),
        };
        let outlook = foresight.predict(state, sent_v, voltage_v);
        let end_rad = foresight.nearer_end_rad();
        let largest_rad = end_rad - outlook.clearance_rad;
        let largest_rad = if largest_rad.is_nan() { f32::INFINITY } else { largest_rad };
        self.angle = Some(ForeseenAngle { largest_rad, end_rad });
        let beyond_rad = Some(-outlook.clearance_rad).filter(|beyond| beyond.is_finite());
        let particle = outlook.particle;
        (!outlook.holds).then_some(Foreseen { identified, particle, beyond_rad })
    }

    /// The prediction for the voltage of the last [`Self::too_late_for`]; `None` before the first.
    #[must_use]
    pub fn angle(&self) -> Option<ForeseenAngle> {
        self.angle
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{
        CONTROL_PERIOD_S, NonidealDynamics, Nonidealities, PlantModel, Profile, QubeModel,
        quantised, runge_kutta_4,
    };
    use crate::safety::{ForesightSettings, IdentifiedQube};

    /// Simulates a Qube that is pushed to and fro and whose motor gets this fraction of the
    /// voltage. Returns the foresight, and whether the Qube contradicted the profile.
    fn follow(profile: &Profile, plant: &QubeModel, share: f64) -> (TrustedForesight, bool) {
        let identified = Some(IdentifiedQube::of(profile, &PlantModel::QUBE));
        let settings = ForesightSettings { identified, ..ForesightSettings::default() };
        let mut foresight = settings.foresight(None, &PlantModel::QUBE);
        foresight.begin_policy();
        let plant = QubeModel {
            nonidealities: Nonidealities { command_delay_s: 0.01, ..plant.nonidealities },
            ..*plant
        };
        let dynamics = NonidealDynamics::new(&plant);
        let (mut state, mut sent_v) = (State::default(), [0.0; MAX_HISTORY]);
        let mut before = state;
        let mut contradicted = false;
        for tick in 0..200_u64 {
            let seen = State {
                theta: quantised(state.theta),
                alpha: quantised(state.alpha),
                theta_dot: (quantised(state.theta) - quantised(before.theta)) / CONTROL_PERIOD_S,
                alpha_dot: (quantised(state.alpha) - quantised(before.alpha)) / CONTROL_PERIOD_S,
            };
            before = state;
            contradicted |= foresight.contradiction(&seen, 10_000 * tick, &sent_v).is_some();
            // The voltage of the last period arrives in this one.
            let arriving_v = share * f64::from(sent_v[0]);
            let voltage_v = if tick % 30 < 15 { 3.5 } else { -3.5 };
            for _ in 0..20 {
                state = runge_kutta_4(&dynamics, state, arriving_v, CONTROL_PERIOD_S / 20.0);
            }
            sent_v.rotate_right(1);
            sent_v[0] = voltage_v;
        }
        (foresight, contradicted)
    }

    #[test]
    fn a_profile_is_trusted_while_it_predicts_and_no_longer() {
        let lab = Profile::lab();
        let model = lab.model();
        let mut other_pendulum = model;
        other_pendulum.parameters.pendulum_length_m *= 1.5;
        let mut heavy_arm = model;
        heavy_arm.parameters.rotary_mass_kg *= 2.0;
        let mut tolerated = model;
        tolerated.parameters.pendulum_mass_kg *= 1.08;
        tolerated.parameters.rotary_mass_kg *= 1.08;
        let exact = Profile::exact("lab", &model);
        for (name, profile, plant, share, kept) in [
            ("the Qube itself", &exact, model, 1.0, true),
            ("masses within the tolerance", &exact, tolerated, 1.0, true),
            ("another pendulum", &exact, other_pendulum, 1.0, false),
            ("another arm", &exact, heavy_arm, 1.0, false),
            ("a weak supply", &exact, model, 0.5, false),
            ("the Qube itself, identified", &lab, model, 1.0, true),
            ("masses within the tolerance, identified", &lab, tolerated, 1.0, true),
            ("another pendulum, identified", &lab, other_pendulum, 1.0, false),
        ] {
            let (foresight, contradicted) = follow(profile, &plant, share);
            assert_eq!(contradicted, !kept, "{name}");
            let trust = if kept { Trust::Earned } else { Trust::Lost };
            assert_eq!(foresight.identified.unwrap().trust, trust, "{name}");
        }
    }
}
