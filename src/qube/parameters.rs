use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The nine domain parameters xi that a simulation may draw anew for each trajectory.
///
/// The inertias of arm and pendulum follow from masses and lengths and are never drawn
/// independently.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DomainParameters {
    /// Gravity g, m/s^2.
    #[serde(rename = "g")]
    pub gravity_m_s2: f64,
    /// Motor resistance R_m, ohm.
    #[serde(rename = "R_m")]
    pub motor_resistance_ohm: f64,
    /// Back-EMF constant k_m of the motor, V s/rad; it equals the torque constant in N m/A.
    #[serde(rename = "k_m")]
    pub motor_back_emf_v_s: f64,
    /// Viscous damping of the arm D_r, N m s/rad.
    #[serde(rename = "D_r")]
    pub rotary_damping_n_m_s: f64,
    /// Viscous damping of the pendulum D_p, N m s/rad.
    #[serde(rename = "D_p")]
    pub pendulum_damping_n_m_s: f64,
    /// Mass of the arm M_r, kg.
    #[serde(rename = "M_r")]
    pub rotary_mass_kg: f64,
    /// Mass of the pendulum M_p, kg.
    #[serde(rename = "M_p")]
    pub pendulum_mass_kg: f64,
    /// Length of the arm L_r, m.
    #[serde(rename = "L_r")]
    pub rotary_length_m: f64,
    /// Length of the pendulum L_p, m.
    #[serde(rename = "L_p")]
    pub pendulum_length_m: f64,
}

/// The nine domain parameters by name, in the order of the thesis's table 5.1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum DomainParameter {
    /// Gravity g.
    Gravity,
    /// Motor resistance R_m.
    MotorResistance,
    /// Back-EMF constant k_m.
    MotorBackEmf,
    /// Damping of the arm D_r.
    RotaryDamping,
    /// Damping of the pendulum D_p.
    PendulumDamping,
    /// Mass of the arm M_r.
    RotaryMass,
    /// Mass of the pendulum M_p.
    PendulumMass,
    /// Length of the arm L_r.
    RotaryLength,
    /// Length of the pendulum L_p.
    PendulumLength,
}

/// The reason why domain parameters are not physical.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ParameterError {
    /// Gravity, resistance, a mass or a length is not above zero.
    #[error("{symbol} = {value} is not physical: it must be above 0")]
    NotPositive {
        /// The parameter's symbol.
        symbol: &'static str,
        /// Value of the parameter, in its unit.
        value: f64,
    },
    /// A damping or the motor constant is below zero.
    #[error("{symbol} = {value} is not physical: it must not be below 0")]
    Negative {
        /// The parameter's symbol.
        symbol: &'static str,
        /// Value of the parameter, in its unit.
        value: f64,
    },
    /// The value is not a number, or larger than [`DomainParameter::largest`].
    #[error("{symbol} = {value}: give a number up to {largest} {unit}")]
    OutOfRange {
        /// The parameter's symbol.
        symbol: &'static str,
        /// Value of the parameter, in its unit.
        value: f64,
        /// Largest accepted value of the parameter.
        largest: f64,
        /// Unit of the value and of the largest accepted value.
        unit: &'static str,
    },
}

impl DomainParameter {
    /// The masses and lengths: the parameters that psi sets in the thesis's search space, that the
    /// model `nominal-handcrafted` randomises, and whose densities the thesis's figure 5.2 shows.
    pub const MASSES_AND_LENGTHS: [Self; 4] =
        [Self::RotaryMass, Self::PendulumMass, Self::RotaryLength, Self::PendulumLength];

    /// Largest accepted value of this parameter in its SI unit. The limits of masses and lengths
    /// fit table-top pendulums, so that most masses in g and lengths in cm or mm are refused.
    #[must_use]
    pub fn largest(self) -> f64 {
        match self {
            Self::RotaryMass | Self::PendulumMass => 10.0,
            Self::RotaryLength | Self::PendulumLength => 5.0,
            Self::Gravity
            | Self::MotorResistance
            | Self::MotorBackEmf
            | Self::RotaryDamping
            | Self::PendulumDamping => 1e3,
        }
    }

    /// All nine parameters, in the order of the thesis's table 5.1.
    pub const ALL: [Self; 9] = [
        Self::Gravity,
        Self::MotorResistance,
        Self::MotorBackEmf,
        Self::RotaryDamping,
        Self::PendulumDamping,
        Self::RotaryMass,
        Self::PendulumMass,
        Self::RotaryLength,
        Self::PendulumLength,
    ];

    /// The symbol that files and tables use: `g`, `R_m`, `k_m`, `D_r`, `D_p`, `M_r`, `M_p`, `L_r`,
    /// `L_p`.
    #[must_use]
    pub fn symbol(self) -> &'static str {
        ["g", "R_m", "k_m", "D_r", "D_p", "M_r", "M_p", "L_r", "L_p"][self as usize]
    }

    /// The parameter with this symbol.
    #[must_use]
    pub fn from_symbol(symbol: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|parameter| parameter.symbol() == symbol)
    }

    /// Unit of this parameter.
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::Gravity => "m/s^2",
            Self::MotorResistance => "ohm",
            Self::MotorBackEmf => "V s/rad",
            Self::RotaryDamping | Self::PendulumDamping => "N m s/rad",
            Self::RotaryMass | Self::PendulumMass => "kg",
            Self::RotaryLength | Self::PendulumLength => "m",
        }
    }

    /// Returns whether zero is allowed: a Qube may lack damping or motor torque on paper, but not
    /// mass.
    #[must_use]
    pub fn may_be_zero(self) -> bool {
        matches!(self, Self::MotorBackEmf | Self::RotaryDamping | Self::PendulumDamping)
    }

    /// Returns whether the parameter is the damping of the arm or of the pendulum.
    #[must_use]
    pub fn is_damping(self) -> bool {
        matches!(self, Self::RotaryDamping | Self::PendulumDamping)
    }
}

impl DomainParameters {
    /// The values on the name plate (thesis, table 5.1).
    pub const NOMINAL: Self = Self {
        gravity_m_s2: 9.81,
        motor_resistance_ohm: 8.4,
        motor_back_emf_v_s: 0.042,
        rotary_damping_n_m_s: 5e-6,
        pendulum_damping_n_m_s: 1e-6,
        rotary_mass_kg: 0.095,
        pendulum_mass_kg: 0.024,
        rotary_length_m: 0.085,
        pendulum_length_m: 0.129,
    };

    /// The value of one parameter, in its SI unit.
    #[must_use]
    pub fn get(&self, parameter: DomainParameter) -> f64 {
        match parameter {
            DomainParameter::Gravity => self.gravity_m_s2,
            DomainParameter::MotorResistance => self.motor_resistance_ohm,
            DomainParameter::MotorBackEmf => self.motor_back_emf_v_s,
            DomainParameter::RotaryDamping => self.rotary_damping_n_m_s,
            DomainParameter::PendulumDamping => self.pendulum_damping_n_m_s,
            DomainParameter::RotaryMass => self.rotary_mass_kg,
            DomainParameter::PendulumMass => self.pendulum_mass_kg,
            DomainParameter::RotaryLength => self.rotary_length_m,
            DomainParameter::PendulumLength => self.pendulum_length_m,
        }
    }

    /// Sets one parameter, in its SI unit.
    pub fn set(&mut self, parameter: DomainParameter, value: f64) {
        *match parameter {
            DomainParameter::Gravity => &mut self.gravity_m_s2,
            DomainParameter::MotorResistance => &mut self.motor_resistance_ohm,
            DomainParameter::MotorBackEmf => &mut self.motor_back_emf_v_s,
            DomainParameter::RotaryDamping => &mut self.rotary_damping_n_m_s,
            DomainParameter::PendulumDamping => &mut self.pendulum_damping_n_m_s,
            DomainParameter::RotaryMass => &mut self.rotary_mass_kg,
            DomainParameter::PendulumMass => &mut self.pendulum_mass_kg,
            DomainParameter::RotaryLength => &mut self.rotary_length_m,
            DomainParameter::PendulumLength => &mut self.pendulum_length_m,
        } = value;
    }

    /// Checks that the values are physical.
    ///
    /// # Errors
    /// Names the first parameter that is not a number, too large, below 0, or 0 although it must be
    /// above 0.
    pub fn check(&self) -> Result<(), ParameterError> {
        for parameter in DomainParameter::ALL {
            let (symbol, value) = (parameter.symbol(), self.get(parameter));
            let largest = parameter.largest();
            if value.is_nan() || value > largest {
                let unit = parameter.unit();
                return Err(ParameterError::OutOfRange { symbol, value, largest, unit });
            }
            if value < 0.0 && parameter.may_be_zero() {
                return Err(ParameterError::Negative { symbol, value });
            }
            if value <= 0.0 && !parameter.may_be_zero() {
                return Err(ParameterError::NotPositive { symbol, value });
            }
        }
        Ok(())
    }

    /// Moment of inertia of the arm, J_r = M_r L_r^2 / 12, kg m^2.
    #[must_use]
    pub fn rotary_inertia_kg_m2(&self) -> f64 {
        self.rotary_mass_kg * self.rotary_length_m * self.rotary_length_m / 12.0
    }

    /// Moment of inertia of the pendulum about its centre, J_p = M_p L_p^2 / 12, kg m^2.
    #[must_use]
    pub fn pendulum_inertia_kg_m2(&self) -> f64 {
        self.pendulum_mass_kg * self.pendulum_length_m * self.pendulum_length_m / 12.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_parameter_is_set_and_read_under_its_own_name() {
        let mut parameters = DomainParameters::NOMINAL;
        for (index, parameter) in DomainParameter::ALL.into_iter().enumerate() {
            parameters.set(parameter, 1.0 + index as f64);
            assert_eq!(DomainParameter::from_symbol(parameter.symbol()), Some(parameter));
        }
        let values = DomainParameter::ALL.map(|parameter| parameters.get(parameter));
        assert_eq!(values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
    }

    #[test]
    fn a_parameter_that_is_not_physical_is_named() {
        let mut parameters = DomainParameters::NOMINAL;
        assert_eq!(parameters.check(), Ok(()));
        parameters.pendulum_mass_kg = 0.0;
        assert_eq!(
            parameters.check(),
            Err(ParameterError::NotPositive { symbol: "M_p", value: 0.0 })
        );
        // 24 is the pendulum's mass in g.
        for wrong in [f64::NAN, f64::INFINITY, 1e300, 24.0] {
            parameters.pendulum_mass_kg = wrong;
            let refused = parameters.check();
            assert!(matches!(refused, Err(ParameterError::OutOfRange { symbol: "M_p", .. })));
        }
        parameters =
            DomainParameters { pendulum_damping_n_m_s: -1e-9, ..DomainParameters::NOMINAL };
        assert!(matches!(parameters.check(), Err(ParameterError::Negative { symbol: "D_p", .. })));
    }
}
