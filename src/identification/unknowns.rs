use crate::qube::{
    DomainParameter, DomainParameters, Nonideality, PlantModel, Quantity, QubeModel,
};

/// A quantity that a fit may move. Its unit in the fit is the logarithm for a parameter, and the SI
/// unit for a nonideality. Gravity is known and never moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unknown(pub Quantity);

/// The prior of an unknown, in the fit's unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NormalPrior {
    /// Mean; for parameters, the mean of the logarithm.
    pub mean: f64,
    /// Standard deviation; for parameters, the standard deviation of the logarithm.
    pub std: f64,
}

impl Unknown {
    /// Every unknown, in the order of tables and files.
    pub fn all() -> impl Iterator<Item = Self> {
        let gravity = Quantity::Parameter(DomainParameter::Gravity);
        Quantity::all().filter(move |quantity| *quantity != gravity).map(Self)
    }

    /// The name in tables and files.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.0.name()
    }

    /// The prior of a plant's specimens without any recording: ruler and balance measure lengths to
    /// 3 % and masses to 10 %; published values of resistance and motor constant differ by a third,
    /// published values of viscous friction by a factor of 50, and published values of Coulomb
    /// friction by as much as the motor's torque at 0.3 V. Every nonideality has the mean 0.
    /// Coulomb friction and the cable's stiffness of another plant than the Qube are expected in
    /// the proportion of the two motors' torques.
    #[must_use]
    pub fn prior(self, plant: &PlantModel) -> NormalPrior {
        let (mean, std) = match self.0 {
            Quantity::Parameter(parameter) => (
                likely(parameter, plant).ln(),
                match parameter {
                    DomainParameter::Gravity => 0.0,
                    DomainParameter::RotaryLength | DomainParameter::PendulumLength => 0.03,
                    DomainParameter::RotaryMass | DomainParameter::PendulumMass => 0.1,
                    DomainParameter::MotorResistance | DomainParameter::MotorBackEmf => 0.35,
                    DomainParameter::RotaryDamping | DomainParameter::PendulumDamping => 2.0,
                },
            ),
            Quantity::Nonideality(term) => (
                0.0,
                plant.proportion(self.0)
                    * match term {
                        Nonideality::CoulombTorque => 1.5e-3,
                        Nonideality::PositiveDeadZone | Nonideality::NegativeDeadZone => 0.3,
                        Nonideality::CableStiffness => 5e-3,
                        Nonideality::CableRest => 0.5,
                        Nonideality::CommandDelay => 0.02,
                    },
            ),
        };
        NormalPrior { mean, std }
    }

    /// The unknown's value in a model, in the fit's unit: the logarithm of a parameter, a
    /// nonideality in its SI unit.
    #[must_use]
    pub fn of(self, model: &QubeModel) -> f64 {
        let value = model.get(self.0);
        if self.is_parameter() { value.ln() } else { value }
    }

    /// Sets the unknown in a model to `value`, which is in the fit's unit; a strength
    /// ([`Self::is_strength`]) below 0 becomes 0.
    pub fn set(self, model: &mut QubeModel, value: f64) {
        let value = if self.is_strength() { value.max(0.0) } else { value };
        model.set(self.0, self.quantity(value));
    }

    /// Returns whether the unknown is a nonideality that cannot be negative: all but the cable's
    /// rest angle. It is false for parameters, whose logarithms may be negative.
    #[must_use]
    pub fn is_strength(self) -> bool {
        matches!(self.0, Quantity::Nonideality(term) if term != Nonideality::CableRest)
    }

    /// Sets a parameter to its most likely value if it is not above 0 and so has no logarithm.
    pub(super) fn start(self, model: &mut QubeModel, plant: &PlantModel) {
        if let Quantity::Parameter(parameter) = self.0
            && model.get(self.0) <= 0.0
        {
            model.set(self.0, likely(parameter, plant));
        }
    }

    /// Converts a value from the fit's unit to the SI unit of the quantity.
    #[must_use]
    pub fn quantity(self, value: f64) -> f64 {
        if self.is_parameter() { value.exp() } else { value }
    }

    /// Converts a small deviation about `value`, both in the fit's unit, to the SI unit of the
    /// quantity.
    #[must_use]
    pub fn deviation(self, value: f64, deviation: f64) -> f64 {
        if self.is_parameter() { value.exp() * deviation } else { deviation }
    }

    /// Returns whether the unknown is a domain parameter, which moves by its logarithm.
    #[must_use]
    pub fn is_parameter(self) -> bool {
        matches!(self.0, Quantity::Parameter(_))
    }
}

/// Most likely value of a plant's parameter before any recording: the value in the plant's
/// description. For a damping that the description leaves at 0, which has no logarithm, it is the
/// Qube's value in the proportion of the two motors.
fn likely(parameter: DomainParameter, plant: &PlantModel) -> f64 {
    let own = plant.parameters.get(parameter);
    if own > 0.0 {
        own
    } else {
        plant.torque_per_qube_torque() * DomainParameters::NOMINAL.get(parameter)
    }
}

impl<Q: Into<Quantity>> From<Q> for Unknown {
    fn from(quantity: Q) -> Self {
        Self(quantity.into())
    }
}
