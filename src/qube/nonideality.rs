use std::ops::RangeInclusive;

/// One term of the [`Nonidealities`](super::Nonidealities): any but the cable's drift.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Nonideality {
    /// Coulomb friction of the arm, N m.
    CoulombTorque,
    /// Dead zone for positive voltages, V.
    PositiveDeadZone,
    /// Dead zone for negative voltages, V.
    NegativeDeadZone,
    /// Stiffness of the cable, N m/rad.
    CableStiffness,
    /// The cable's rest angle, rad.
    CableRest,
    /// Time until a command acts at the motor, s: `command_delay_s` of the
    /// [`Nonidealities`](super::Nonidealities).
    CommandDelay,
}

impl Nonideality {
    /// All terms, in order. The cable's drift is not among them: only the emulator has it.
    pub const ALL: [Self; 6] = [
        Self::CoulombTorque,
        Self::PositiveDeadZone,
        Self::NegativeDeadZone,
        Self::CableStiffness,
        Self::CableRest,
        Self::CommandDelay,
    ];

    /// The name in profiles, with its unit.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::CoulombTorque => "coulomb_torque_n_m",
            Self::PositiveDeadZone => "positive_dead_zone_v",
            Self::NegativeDeadZone => "negative_dead_zone_v",
            Self::CableStiffness => "cable_stiffness_n_m_rad",
            Self::CableRest => "cable_rest_rad",
            Self::CommandDelay => "command_delay_s",
        }
    }

    /// The symbol of the term in psi and in the tables of psi.
    #[must_use]
    pub fn symbol(self) -> &'static str {
        match self {
            Self::CoulombTorque => "coulomb",
            Self::PositiveDeadZone => "positive_dead_zone",
            Self::NegativeDeadZone => "negative_dead_zone",
            Self::CableStiffness => "cable_stiffness",
            Self::CableRest => "cable_rest",
            Self::CommandDelay => "delay",
        }
    }

    /// The accepted range, in the unit of the term. Only the rest angle may be negative.
    #[must_use]
    pub fn range(self) -> RangeInclusive<f64> {
        match self {
            Self::CoulombTorque | Self::CableStiffness | Self::CommandDelay => 0.0..=0.1,
            Self::PositiveDeadZone | Self::NegativeDeadZone => 0.0..=5.0,
            Self::CableRest => -10.0..=10.0,
        }
    }
}
