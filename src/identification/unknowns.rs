use crate::qube::{DomainParameter, DomainParameters, Gap, QubeModel};

/// One quantity that a fit may move. Gravity is known, and is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unknown {
    /// One of the thesis's parameters: moved by its logarithm.
    Parameter(DomainParameter),
    /// Coulomb friction of the arm.
    CoulombTorque,
    /// Dead zone for positive voltages.
    PositiveDeadZone,
    /// Dead zone for negative voltages.
    NegativeDeadZone,
    /// Stiffness of the cable.
    CableStiffness,
    /// Where the cable does not pull.
    CableRest,
    /// From command to motor.
    CommandDelay,
}

/// What is known of an unknown before there is data, in its own unit of movement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prior {
    /// Most likely value: the logarithm's for parameters.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
}

impl Unknown {
    /// All of them, in the order of tables and files.
    pub const ALL: [Self; 14] = [
        Self::Parameter(DomainParameter::MotorResistance),
        Self::Parameter(DomainParameter::MotorBackEmf),
        Self::Parameter(DomainParameter::RotaryDamping),
        Self::Parameter(DomainParameter::PendulumDamping),
        Self::Parameter(DomainParameter::RotaryMass),
        Self::Parameter(DomainParameter::PendulumMass),
        Self::Parameter(DomainParameter::RotaryLength),
        Self::Parameter(DomainParameter::PendulumLength),
        Self::CoulombTorque,
        Self::PositiveDeadZone,
        Self::NegativeDeadZone,
        Self::CableStiffness,
        Self::CableRest,
        Self::CommandDelay,
    ];

    /// Its name in tables and files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Parameter(parameter) => parameter.symbol(),
            Self::CoulombTorque => "coulomb_torque_n_m",
            Self::PositiveDeadZone => "positive_dead_zone_v",
            Self::NegativeDeadZone => "negative_dead_zone_v",
            Self::CableStiffness => "cable_stiffness_n_m_rad",
            Self::CableRest => "cable_rest_rad",
            Self::CommandDelay => "command_delay_s",
        }
    }

    /// What can be said without a recording: a ruler and a balance know lengths to 3 % and masses
    /// to 10 %; published values of resistance and motor constant differ by a third, those of
    /// friction by a factor of 50 (Coulomb friction by as much as the motor's torque at 0.3 V).
    #[must_use]
    pub fn prior(self) -> Prior {
        use DomainParameter as P;
        let (mean, std) = match self {
            Self::Parameter(parameter) => (
                DomainParameters::NOMINAL.get(parameter).ln(),
                match parameter {
                    P::Gravity => 0.0,
                    P::RotaryLength | P::PendulumLength => 0.03,
                    P::RotaryMass | P::PendulumMass => 0.1,
                    P::MotorResistance | P::MotorBackEmf => 0.35,
                    P::RotaryDamping | P::PendulumDamping => 2.0,
                },
            ),
            Self::CoulombTorque => (0.0, 1.5e-3),
            Self::PositiveDeadZone | Self::NegativeDeadZone => (0.0, 0.3),
            Self::CableStiffness => (0.0, 5e-3),
            Self::CableRest => (0.0, 0.5),
            Self::CommandDelay => (0.0, 0.02),
        };
        Prior { mean, std }
    }

    /// Whether a value below zero means nothing.
    fn is_positive(self) -> bool {
        !matches!(self, Self::Parameter(_) | Self::CableRest)
    }

    /// Where a model stands in this unknown, in the unit of movement.
    #[must_use]
    pub fn of(self, model: &QubeModel) -> f64 {
        let gap = &model.gap;
        match self {
            Self::Parameter(parameter) => model.parameters.get(parameter).ln(),
            Self::CoulombTorque => gap.coulomb_torque_n_m,
            Self::PositiveDeadZone => gap.positive_dead_zone_v,
            Self::NegativeDeadZone => gap.negative_dead_zone_v,
            Self::CableStiffness => gap.cable_stiffness_n_m_rad,
            Self::CableRest => gap.cable_rest_rad,
            Self::CommandDelay => gap.command_delay_s,
        }
    }

    /// Moves a model to this value, or as near as has a meaning.
    pub fn set(self, model: &mut QubeModel, moved: f64) {
        let moved = if self.is_positive() { moved.max(0.0) } else { moved };
        let gap: &mut Gap = &mut model.gap;
        match self {
            Self::Parameter(parameter) => model.parameters.set(parameter, moved.exp()),
            Self::CoulombTorque => gap.coulomb_torque_n_m = moved,
            Self::PositiveDeadZone => gap.positive_dead_zone_v = moved,
            Self::NegativeDeadZone => gap.negative_dead_zone_v = moved,
            Self::CableStiffness => gap.cable_stiffness_n_m_rad = moved,
            Self::CableRest => gap.cable_rest_rad = moved,
            Self::CommandDelay => gap.command_delay_s = moved,
        }
    }

    /// A value in the unit of movement as the quantity itself, in its SI unit.
    #[must_use]
    pub fn quantity(self, moved: f64) -> f64 {
        if matches!(self, Self::Parameter(_)) { moved.exp() } else { moved }
    }

    /// A small deviation in the unit of movement as one of the quantity.
    #[must_use]
    pub fn deviation(self, moved: f64, deviation: f64) -> f64 {
        if matches!(self, Self::Parameter(_)) { moved.exp() * deviation } else { deviation }
    }
}
