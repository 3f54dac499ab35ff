//! The rigs on which a check must be right, and their possible defects.
//!
//! A rig follows from its seed: all eight wirings; the profile `lab` 0.5, 1 and 1.5 times as far
//! from nominal; parameters within 10 % of the profile's; then 1 to 4 times the dry friction and
//! damping of the arm; up to 1 degree of play. About half of the rigs lie in the corners of that
//! domain. Published figures use seeds from 1000 on, on which nothing was tuned.

use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings, Wiring};
use qube_hil::estimation::Calibration;
use qube_hil::preflight::Examination;
use qube_hil::qube::{DomainParameter, Profile};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// First seed of the rigs on which nothing was tuned.
pub const FIRST_SEED: u64 = 1000;

/// Largest relative deviation of the parameters from the profile's, apart from the factor on the
/// arm's friction and damping.
const SPREAD: f64 = 0.1;

const MOST_PLAY_DEG: f64 = 1.0;

/// One rig of the domain.
pub fn rig(seed: u64) -> EmulatorSettings {
    let lab = Profile::lab().model();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let at_a_corner = random.random_range(0..2) == 0;
    let mut between = |low: f64, high: f64| {
        let share = random.random_range(0.0..=1.0);
        low + (high - low) * if at_a_corner { f64::round(share) } else { share }
    };
    let mut model = lab.scaled([0.5, 1.0, 1.5][(seed / 8 % 3) as usize]);
    for parameter in DomainParameter::ALL {
        let value = model.parameters.get(parameter);
        if parameter != DomainParameter::Gravity {
            model.parameters.set(parameter, value * between(1.0 - SPREAD, 1.0 + SPREAD));
        }
    }
    let friction = between(1.0, 4.0);
    model.nonidealities.coulomb_torque_n_m *= friction;
    let damping = model.parameters.rotary_damping_n_m_s;
    model.parameters.rotary_damping_n_m_s = damping * friction;
    EmulatorSettings {
        model,
        play_rad: between(0.0, MOST_PLAY_DEG).to_radians(),
        wiring: Wiring {
            theta_inverted: seed & 1 != 0,
            alpha_inverted: seed & 2 != 0,
            motor_inverted: seed & 4 != 0,
        },
        seed,
        ..EmulatorSettings::default()
    }
}

/// The signs of a rig with this wiring.
pub fn signs_of(wiring: Wiring) -> Calibration {
    Calibration {
        theta_inverted: wiring.theta_inverted,
        alpha_inverted: wiring.alpha_inverted,
        voltage_inverted: wiring.motor_inverted,
        ..Calibration::IDENTITY
    }
}

/// The names of the checks that failed.
pub fn failed(found: &Examination) -> Vec<&str> {
    found
        .results
        .iter()
        .filter(|result| result.failed())
        .map(|result| result.name.as_str())
        .collect()
}

/// A defect of a rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Defect {
    ThetaSign,
    AlphaSign,
    MotorSign,
    DeadArmEncoder,
    DeadPendulumEncoder,
    HeldArm,
    DeadMotor,
    NoPendulum,
    HeldPendulum,
    ExchangedEncoders,
}

pub const DEFECTS: [Defect; 10] = [
    Defect::ThetaSign,
    Defect::AlphaSign,
    Defect::MotorSign,
    Defect::DeadArmEncoder,
    Defect::DeadPendulumEncoder,
    Defect::HeldArm,
    Defect::DeadMotor,
    Defect::NoPendulum,
    Defect::HeldPendulum,
    Defect::ExchangedEncoders,
];

impl Defect {
    /// The one check that must fail.
    pub fn name(self) -> &'static str {
        match self {
            Self::ThetaSign => "arm-sign",
            Self::AlphaSign => "pendulum-sign",
            Self::MotorSign => "motor-sign",
            Self::DeadArmEncoder => "arm",
            Self::DeadPendulumEncoder
            | Self::NoPendulum
            | Self::HeldPendulum
            | Self::ExchangedEncoders => "pendulum",
            Self::HeldArm => "stall",
            Self::DeadMotor => "motor",
        }
    }

    /// A rig with this defect, and the signs in its file.
    pub fn of(self, mut rig: EmulatorSettings) -> (EmulatorSettings, Calibration) {
        let mut signs = signs_of(rig.wiring);
        let after_s = 0.0;
        match self {
            Self::ThetaSign => signs.theta_inverted ^= true,
            Self::AlphaSign => signs.alpha_inverted ^= true,
            Self::MotorSign => signs.voltage_inverted ^= true,
            Self::DeadArmEncoder => rig.fault = Some(EmulatorFault::FrozenTheta { after_s }),
            Self::DeadPendulumEncoder => rig.fault = Some(EmulatorFault::FrozenAlpha { after_s }),
            Self::HeldArm => rig.fault = Some(EmulatorFault::BlockedArm { after_s }),
            Self::ExchangedEncoders => rig.fault = Some(EmulatorFault::ExchangedEncoders),
            Self::DeadMotor => rig.fault = Some(EmulatorFault::DeadMotor { after_s }),
            Self::NoPendulum | Self::HeldPendulum => {
                // The encoder's shaft does not turn against the arm. A pendulum that is fixed to
                // the arm adds its mass at the arm's end (J_r = M_r L_r^2 / 12).
                rig.fault = Some(EmulatorFault::FrozenAlpha { after_s });
                let parameters = &mut rig.model.parameters;
                if self == Self::HeldPendulum {
                    parameters.rotary_mass_kg += 12.0 * parameters.pendulum_mass_kg;
                }
                parameters.pendulum_mass_kg = 1e-6;
            }
        }
        (rig, signs)
    }
}

/// The number in an environment variable; `default` if the variable is not set. Panics if the value
/// is no whole number.
pub fn number(name: &str, default: u64) -> u64 {
    let Some(value) = std::env::var_os(name) else { return default };
    let number = value.to_str().and_then(|text| text.parse().ok());
    number.unwrap_or_else(|| panic!("{name} is {value:?}, which is no whole number"))
}

/// The results of these seeds in their order, computed on all processors.
pub fn of_each<T: Send>(seeds: std::ops::Range<u64>, play: impl Fn(u64) -> T + Sync) -> Vec<T> {
    let threads = std::thread::available_parallelism().map_or(1, |count| count.get()) as u64;
    let (seeds, play) = (&seeds, &play);
    let mut found: Vec<(u64, T)> = std::thread::scope(|scope| {
        let each = |first: u64| seeds.clone().skip(first as usize).step_by(threads as usize);
        let start = |first: u64| {
            scope.spawn(move || each(first).map(|seed| (seed, play(seed))).collect::<Vec<_>>())
        };
        let running: Vec<_> = (0..threads).map(start).collect();
        running.into_iter().flat_map(|thread| thread.join().unwrap()).collect()
    });
    found.sort_by_key(|(seed, _)| *seed);
    found.into_iter().map(|(_, of_rig)| of_rig).collect()
}
