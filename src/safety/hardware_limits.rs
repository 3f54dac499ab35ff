use thiserror::Error;

use super::{Guard, SafetyBox};
use crate::qube::{MotorRating, PlantModel, PlantName};

/// The operator's consent that the arm may reach its hard stop, given on the command line of the
/// process that drives.
///
/// It cannot be read from a file and has no default; [`given`](Self::given) is the only way to
/// obtain one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GuardConsent(());

impl GuardConsent {
    /// Consent from the two flags of a command line; `None` unless the first is [`Guard::Box`] and
    /// the second is given.
    #[must_use]
    pub fn given(guard: Option<Guard>, accepts_hard_stop: bool) -> Option<Self> {
        (guard == Some(Guard::Box) && accepts_hard_stop).then_some(Self(()))
    }
}

/// The operator's consent to the entries of a plant file for real hardware, given on the command
/// line of the process that drives.
///
/// Like a [`GuardConsent`] it cannot be read from a file and has no default.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlantConsent(());

impl PlantConsent {
    /// Consent from the flag of a command line.
    #[must_use]
    pub fn given(accepts_plant: bool) -> Option<Self> {
        accepts_plant.then_some(Self(()))
    }
}

/// The limits within which hardware may be driven: the widest box, the rating of the motor, and the
/// consent to a plant file. The box is no wider than the task's, [`SafetyBox::GUARDED`], and its
/// guard is foresight unless the operator gave a [`GuardConsent`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HardwareLimits {
    widest: SafetyBox,
    motor: MotorRating,
    plant_consent: Option<PlantConsent>,
}

/// The reason why a box or a plant is refused for hardware.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum HardwareRefusal {
    /// A limit is not a number above 0, or is larger than allowed.
    #[error("safety_box.{name} = {value}: give a number above 0, at most {widest}")]
    Limit {
        /// Name of the limit.
        name: &'static str,
        /// Value of the limit, in its unit.
        value: f64,
        /// Largest accepted value.
        widest: f64,
    },
    /// The box has no guard, and nobody has consented to that.
    #[error(
        "guard = \"box\" lets a policy drive the arm of a real Qube into its hard stop: leave the \
         guard on (guard = \"foresight\")"
    )]
    GuardOff,
    /// An entry of the plant file is not known to be as harmless as a Qube's, and nobody has
    /// consented to it.
    #[error(
        "the plant {plant} differs from a Qube in {entry}, and on hardware guard and homing rely on \
         the values of its file"
    )]
    Plant {
        /// Name of the plant.
        plant: PlantName,
        /// Entry of the plant file.
        entry: &'static str,
    },
    /// The guard is only for replays of old recordings.
    #[error(
        "guard = \"envelope\" is only for replays of old recordings: give guard = \"foresight\""
    )]
    EnvelopeGone,
}

impl HardwareLimits {
    /// Limits from a box.
    ///
    /// # Errors
    /// The box is wider than the task's, has no guard without consent, or has a guard that only
    /// serves to replay old recordings.
    pub fn of(
        safety_box: SafetyBox,
        consent: Option<GuardConsent>,
    ) -> Result<Self, HardwareRefusal> {
        let guard = if consent.is_some() { Guard::Box } else { Guard::Foresight };
        let of_the_task =
            Self { widest: SafetyBox { guard, ..SafetyBox::GUARDED }, ..Self::default() };
        of_the_task.admit(&safety_box)?;
        Ok(Self { widest: safety_box, ..Self::default() })
    }

    /// Replaces the motor rating.
    #[must_use]
    pub fn with_motor(self, motor: MotorRating) -> Self {
        Self { motor, ..self }
    }

    /// Replaces the consent to the plant.
    #[must_use]
    pub fn with_plant_consent(self, plant_consent: Option<PlantConsent>) -> Self {
        Self { plant_consent, ..self }
    }

    /// Checks that hardware may be driven as this plant.
    ///
    /// # Errors
    /// The plant differs from a Qube in more than smaller limits and a lower motor rating, and
    /// there is no [`PlantConsent`].
    pub fn admit_plant(&self, plant: &PlantModel) -> Result<(), HardwareRefusal> {
        match plant.beyond_qube() {
            Some(entry) if self.plant_consent.is_none() => {
                Err(HardwareRefusal::Plant { plant: plant.name, entry })
            }
            _ => Ok(()),
        }
    }

    /// Rating of the motor.
    #[must_use]
    pub fn motor(&self) -> MotorRating {
        self.motor
    }

    /// Returns whether every rollout within these limits uses foresight.
    #[must_use]
    pub fn needs_foresight(&self) -> bool {
        self.widest.guard == Guard::Foresight
    }

    /// Checks that a rollout may use this box.
    ///
    /// # Errors
    /// The box is wider than these limits, has no guard although they require one, or has a guard
    /// that only serves to replay old recordings.
    pub fn admit(&self, safety_box: &SafetyBox) -> Result<(), HardwareRefusal> {
        safety_box.check_within(&self.widest)?;
        safety_box.guard.check_driven()?;
        if safety_box.guard.is_box() && !self.widest.guard.is_box() {
            return Err(HardwareRefusal::GuardOff);
        }
        Ok(())
    }
}

impl Guard {
    /// Checks that a rollout may begin under this guard, on any Qube.
    ///
    /// # Errors
    /// The guard exists only to replay old recordings.
    pub fn check_driven(self) -> Result<(), HardwareRefusal> {
        if self == Self::Envelope { Err(HardwareRefusal::EnvelopeGone) } else { Ok(()) }
    }
}

impl Default for HardwareLimits {
    /// The task's box under foresight, the nominal motor, and no consent to a plant file.
    fn default() -> Self {
        Self { widest: SafetyBox::GUARDED, motor: MotorRating::NOMINAL, plant_consent: None }
    }
}

impl SafetyBox {
    /// Checks that each limit is a number above 0 and at most the limit of another box; the guards
    /// are not compared.
    ///
    /// # Errors
    /// The first limit that fails the check.
    pub fn check_within(&self, widest: &Self) -> Result<(), HardwareRefusal> {
        for (name, value, widest) in [
            ("theta", self.theta, widest.theta),
            ("alpha", self.alpha, widest.alpha),
            ("theta_dot", self.theta_dot, widest.theta_dot),
            ("alpha_dot", self.alpha_dot, widest.alpha_dot),
        ] {
            // NaN fails both comparisons.
            if !(value > 0.0 && value <= widest) {
                return Err(HardwareRefusal::Limit { name, value, widest });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_guarded() {
        assert_eq!(Guard::default(), Guard::Foresight);
        assert_eq!(SafetyBox::default(), SafetyBox::GUARDED);
        assert_eq!(
            HardwareLimits::default(),
            HardwareLimits::of(SafetyBox::GUARDED, None).unwrap()
        );
    }

    #[test]
    fn a_limit_is_narrowed_and_never_widened() {
        for value in [9.0, 50.0, 2.300001, 0.0, -1.0, f64::NAN, f64::INFINITY] {
            for safety_box in [
                SafetyBox { theta: value, ..SafetyBox::GUARDED },
                SafetyBox { alpha: 10.0 * value, ..SafetyBox::GUARDED },
                SafetyBox { theta_dot: 20.0 * value, ..SafetyBox::GUARDED },
                SafetyBox { alpha_dot: 20.0 * value, ..SafetyBox::GUARDED },
            ] {
                let consent = GuardConsent::given(Some(Guard::Box), true);
                for consent in [None, consent] {
                    let refused = HardwareLimits::of(safety_box, consent).unwrap_err();
                    let message = refused.to_string();
                    assert!(message.contains("at most"), "{message}");
                }
            }
        }
        let narrow = SafetyBox { theta: 1.0, ..SafetyBox::GUARDED };
        let limits = HardwareLimits::of(narrow, None).unwrap();
        assert_eq!(limits.admit(&narrow), Ok(()));
        assert!(limits.admit(&SafetyBox::GUARDED).is_err());
    }

    #[test]
    fn only_the_word_on_the_command_line_admits_another_plant() {
        let mut plant = PlantModel::QUBE;
        let limits = HardwareLimits::default();
        assert_eq!(limits.admit_plant(&plant), Ok(()));
        plant.limits.hard_stop_rad = 1.8;
        assert_eq!(limits.admit_plant(&plant), Ok(()));
        plant.limits.hard_stop_rad = 2.5;
        let refused = limits.admit_plant(&plant).unwrap_err().to_string();
        assert!(refused.contains("limits.hard_stop_rad"), "{refused}");
        let consents = limits.with_plant_consent(PlantConsent::given(true));
        assert_eq!(consents.admit_plant(&plant), Ok(()));
        assert_eq!(PlantConsent::given(false), None);
    }

    #[test]
    fn the_guard_is_off_by_both_words_alone() {
        for (guard, accepts) in [
            (None, false),
            (None, true),
            (Some(Guard::Box), false),
            (Some(Guard::Foresight), false),
            (Some(Guard::Foresight), true),
        ] {
            let consent = GuardConsent::given(guard, accepts);
            assert_eq!(consent, None);
            assert_eq!(
                HardwareLimits::of(SafetyBox::THESIS, consent),
                Err(HardwareRefusal::GuardOff)
            );
        }
        let of_old_recordings = SafetyBox { guard: Guard::Envelope, ..SafetyBox::THESIS };
        let consent = GuardConsent::given(Some(Guard::Box), true);
        for consent in [None, consent] {
            assert_eq!(
                HardwareLimits::of(of_old_recordings, consent),
                Err(HardwareRefusal::EnvelopeGone)
            );
        }
        let limits = HardwareLimits::of(SafetyBox::THESIS, consent).unwrap();
        assert_eq!(limits.admit(&SafetyBox::THESIS), Ok(()));
        assert_eq!(limits.admit(&SafetyBox::GUARDED), Ok(()));
    }
}
