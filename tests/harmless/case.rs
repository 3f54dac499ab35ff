//! The kinds of fault that a start may have, and the seeded starts.

use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::qube::{DomainParameter, HARD_STOP_RAD, Nonidealities, Profile, QubeModel, State};
use qube_hil::telemetry::Fault;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The kind of fault that a start has, if any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Case {
    Healthy,
    ThetaDeadFromTheStart,
    /// The count freezes; the tachometer keeps its last velocity.
    ThetaStuck,
    /// The count freezes; the tachometer shows an arm at rest.
    ThetaDead,
    /// The count freezes for a while; counts in that time are lost.
    ThetaLapse,
    ThetaJump,
    AlphaDeadFromTheStart,
    AlphaFrozen,
    AlphaLapse,
    AlphaJump,
    ThetaSign,
    AlphaSign,
    MotorSign,
    MotorDead,
    MotorDeadLater,
    /// The motor has half of its torque.
    MotorHalf,
    /// The motor has 30 % of its torque.
    MotorWeak,
    ArmHeld,
    ArmHeldLater,
    BesideAStop,
    BesideAStopFalling,
    /// The arm's encoder has half as many lines as a Qube's.
    ThetaHalf,
    /// The arm's encoder has twice as many lines as a Qube's.
    ThetaDouble,
    /// The motor turns in one direction only.
    MotorOneSided,
    /// The encoders of arm and pendulum are plugged into each other's sockets.
    EncodersExchanged,
    ArmPushed,
    PendulumHeld,
}

impl Case {
    pub const ALL: [Self; 27] = [
        Self::Healthy,
        Self::ThetaDeadFromTheStart,
        Self::ThetaStuck,
        Self::ThetaDead,
        Self::ThetaLapse,
        Self::ThetaJump,
        Self::AlphaDeadFromTheStart,
        Self::AlphaFrozen,
        Self::AlphaLapse,
        Self::AlphaJump,
        Self::ThetaSign,
        Self::AlphaSign,
        Self::MotorSign,
        Self::MotorDead,
        Self::MotorDeadLater,
        Self::MotorHalf,
        Self::MotorWeak,
        Self::ArmHeld,
        Self::ArmHeldLater,
        Self::BesideAStop,
        Self::BesideAStopFalling,
        Self::ThetaHalf,
        Self::ThetaDouble,
        Self::MotorOneSided,
        Self::EncodersExchanged,
        Self::ArmPushed,
        Self::PendulumHeld,
    ];

    /// Returns whether the arm's count freezes, for good or for a while, or jumps.
    pub fn is_of_theta_encoder(self) -> bool {
        matches!(
            self,
            Self::ThetaDeadFromTheStart
                | Self::ThetaStuck
                | Self::ThetaDead
                | Self::ThetaLapse
                | Self::ThetaJump
        )
    }

    /// Returns whether a start of this case may end with this fault.
    #[allow(clippy::enum_glob_use)]
    pub fn names_rightly(self, fault: Fault) -> bool {
        use Fault::*;
        match self {
            Self::Healthy | Self::BesideAStop | Self::BesideAStopFalling | Self::MotorHalf => {
                fault == MotorWeak && self == Self::MotorHalf
            }
            Self::ThetaDeadFromTheStart | Self::ThetaStuck | Self::ThetaDead | Self::ThetaLapse => {
                fault == EncoderFrozen
            }
            Self::ThetaJump => fault == EncoderJump,
            Self::AlphaDeadFromTheStart | Self::AlphaFrozen | Self::AlphaLapse => {
                fault == PendulumFrozen
            }
            Self::AlphaJump => fault == PendulumJump,
            Self::ThetaSign => fault == WrongSignTheta,
            Self::AlphaSign => fault == WrongSignAlpha,
            Self::MotorSign => fault == WrongSignMotor,
            Self::MotorDead | Self::MotorDeadLater => fault == MotorDead,
            Self::MotorWeak => fault == MotorWeak,
            Self::ArmHeld | Self::ArmHeldLater => matches!(fault, ArmHeld | Stall),
            Self::ThetaHalf | Self::ThetaDouble => matches!(fault, EncodersDisagree | TravelWrong),
            Self::MotorOneSided => matches!(fault, MotorDead | MotorWeak),
            // The program reads the pendulum's count as the arm's, and a push of the arm hardly
            // changes it.
            Self::EncodersExchanged => matches!(fault, EncoderFrozen | PendulumFrozen),
            // An operator who reads of a wrong sign would invert a correct one.
            Self::ArmPushed | Self::PendulumHeld => {
                !matches!(fault, WrongSignTheta | WrongSignAlpha | WrongSignMotor)
            }
        }
    }

    /// Returns whether a hand moves or holds arm or pendulum; the hand itself may throw the arm
    /// into a stop.
    pub fn is_by_hand(self) -> bool {
        matches!(self, Self::ArmPushed | Self::PendulumHeld)
    }
}

/// The set of Qubes from which a start draws its Qube.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Qubes {
    /// Nominal, `lab`, and `lab` moved 1.5 times as far from nominal; half of them with parameters
    /// up to 10 % off.
    Near,
    /// Any Qube: motor, masses and lengths up to 20 % off; damping of the arm 0.3 to 4 times, of
    /// the pendulum 0.05 to 2 times nominal; friction, cable and delay from none to 2.0 to 2.6
    /// times the values of `lab`, dead zones up to 0.35 V.
    Far,
}

/// One start: a Qube, its initial state, and its fault.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    pub case: Case,
    pub seed: u64,
    pub settings: EmulatorSettings,
    /// Onset of the fault, s of the device's clock; without meaning in a start without a fault.
    pub fault_onset_s: f64,
}

impl Start {
    /// The start of this case and seed on one of `qubes`. In about half of the starts the fault
    /// begins within the first 15 s, during homing; in the others within the first 60 s. Some cases
    /// differ: their fault exists from the start or begins during homing in every start.
    pub fn new(case: Case, seed: u64, qubes: Qubes) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(7);
        let model = match qubes {
            Qubes::Near => near(&mut random, seed),
            Qubes::Far => far(&mut random),
        };
        // Friction holds a resting arm against its cable up to `reach_rad` from `rest_rad`.
        let nonidealities = &model.nonidealities;
        let (rest_rad, reach_rad) = if nonidealities.cable_stiffness_n_m_rad > 0.0 {
            let holds_rad =
                nonidealities.coulomb_torque_n_m / nonidealities.cable_stiffness_n_m_rad;
            (nonidealities.cable_rest_rad, (0.9 * holds_rad).min(1.0))
        } else {
            (0.0, 1.0)
        };
        let theta = (rest_rad + reach_rad * random.random_range(-1.0..1.0))
            .clamp(-HARD_STOP_RAD, HARD_STOP_RAD);
        let swing = if random.random_bool(0.3) { 0.3 } else { 0.0 };
        let mut start =
            State { theta, alpha: random.random_range(-1.0..1.0) * swing, ..State::default() };
        let early = random.random_bool(0.5);
        let mut onset_s = random.random_range(0.0..if early { 15.0 } else { 60.0 });
        let side = if random.random_bool(0.5) { 1.0 } else { -1.0 };
        let counts = random.random_range(60..600) * if random.random_bool(0.5) { 1 } else { -1 };
        let lasts_s = random.random_range(0.3..0.7);
        let falling = State {
            theta: side * (HARD_STOP_RAD - random.random_range(0.0..0.4)),
            alpha: random.random_range(-3.1..3.1),
            alpha_dot: random.random_range(-8.0..8.0),
            theta_dot: 0.0,
        };
        let hand_lasts_s = random.random_range(0.2..1.5);
        let hand_like_v = random.random_range(0.5..3.0) * side;
        if matches!(case, Case::ArmPushed | Case::PendulumHeld | Case::MotorOneSided) {
            // All of them begin during homing: half in the first 6 s, half in the first 15 s.
            onset_s = if early { 0.4 * onset_s } else { 0.25 * onset_s };
        }
        let fault = match case {
            Case::Healthy => None,
            Case::ThetaHalf => Some(EmulatorFault::ScaledTheta { factor: 0.5 }),
            Case::ThetaDouble => Some(EmulatorFault::ScaledTheta { factor: 2.0 }),
            Case::MotorOneSided => {
                Some(EmulatorFault::OneSidedMotor { after_s: onset_s, positive: side > 0.0 })
            }
            Case::ArmPushed => Some(EmulatorFault::PushedArm {
                after_s: onset_s,
                lasts_s: hand_lasts_s,
                like_v: hand_like_v,
            }),
            Case::PendulumHeld => {
                Some(EmulatorFault::HeldPendulum { after_s: onset_s, lasts_s: hand_lasts_s })
            }
            Case::ThetaDeadFromTheStart => {
                onset_s = 0.0;
                Some(EmulatorFault::FrozenTheta { after_s: 0.0 })
            }
            Case::ThetaStuck => Some(EmulatorFault::StuckTheta { after_s: onset_s }),
            Case::ThetaDead => Some(EmulatorFault::FrozenTheta { after_s: onset_s }),
            Case::ThetaLapse => Some(EmulatorFault::LapsingTheta { after_s: onset_s, lasts_s }),
            Case::ThetaJump => Some(EmulatorFault::JumpTheta { after_s: onset_s, counts }),
            Case::AlphaDeadFromTheStart => {
                onset_s = 0.0;
                Some(EmulatorFault::FrozenAlpha { after_s: 0.0 })
            }
            Case::AlphaFrozen => Some(EmulatorFault::FrozenAlpha { after_s: onset_s }),
            Case::AlphaLapse => Some(EmulatorFault::LapsingAlpha { after_s: onset_s, lasts_s }),
            Case::AlphaJump => Some(EmulatorFault::JumpAlpha { after_s: onset_s, counts }),
            Case::ThetaSign => Some(EmulatorFault::FlippedTheta),
            Case::AlphaSign => Some(EmulatorFault::FlippedAlpha),
            Case::MotorSign => Some(EmulatorFault::FlippedMotor),
            Case::EncodersExchanged => Some(EmulatorFault::ExchangedEncoders),
            Case::MotorDead => {
                onset_s = 0.0;
                Some(EmulatorFault::DeadMotor { after_s: 0.0 })
            }
            Case::MotorDeadLater => Some(EmulatorFault::DeadMotor { after_s: onset_s }),
            Case::MotorHalf => Some(EmulatorFault::WeakMotor { share: 0.5 }),
            Case::MotorWeak => Some(EmulatorFault::WeakMotor { share: 0.3 }),
            Case::ArmHeld => {
                onset_s = 0.0;
                Some(EmulatorFault::BlockedArm { after_s: 0.0 })
            }
            Case::ArmHeldLater => Some(EmulatorFault::BlockedArm { after_s: onset_s }),
            Case::BesideAStop => {
                start = State { theta: falling.theta, ..State::default() };
                None
            }
            Case::BesideAStopFalling => {
                start = falling;
                None
            }
        };
        if matches!(
            case,
            Case::ThetaSign
                | Case::AlphaSign
                | Case::MotorSign
                | Case::MotorHalf
                | Case::MotorWeak
                | Case::EncodersExchanged
                | Case::ThetaHalf
                | Case::ThetaDouble
        ) {
            onset_s = 0.0;
        }
        let settings =
            EmulatorSettings { model, seed, fault, start: Some(start), ..Default::default() };
        Self { case, seed, settings, fault_onset_s: onset_s }
    }
}

/// A Qube near nominal and `lab`: in turn nominal, `lab`, and `lab` 1.5 times as far from nominal.
/// Three seeds with parameters up to 10 % off alternate with three exact ones.
fn near(random: &mut ChaCha8Rng, seed: u64) -> QubeModel {
    let lab = Profile::lab().model();
    let mut model = match seed % 3 {
        0 => QubeModel::NOMINAL,
        1 => lab,
        _ => lab.scaled(1.5),
    };
    if (seed / 3).is_multiple_of(2) {
        for parameter in DomainParameter::ALL {
            let factor = random.random_range(0.9..1.1);
            model.parameters.set(parameter, factor * model.parameters.get(parameter));
        }
    }
    model
}

/// A Qube of the far domain. Two thirds have dry friction, two thirds a cable, two thirds a delay
/// of the commands. Three quarters have a dead zone for positive voltages and, independently of
/// that, three quarters have one for negative voltages.
fn far(random: &mut ChaCha8Rng) -> QubeModel {
    let mut model = QubeModel::NOMINAL;
    for parameter in DomainParameter::ALL {
        let factor = match parameter {
            DomainParameter::Gravity => 1.0,
            DomainParameter::RotaryDamping => random.random_range(0.3..4.0),
            DomainParameter::PendulumDamping => random.random_range(0.05..2.0),
            _ => random.random_range(0.8..1.2),
        };
        model.parameters.set(parameter, factor * model.parameters.get(parameter));
    }
    let mut some = |share: f64, largest: f64| {
        let is_there = random.random_bool(share);
        let value = random.random_range(0.0..largest);
        if is_there { value } else { 0.0 }
    };
    model.nonidealities = Nonidealities {
        coulomb_torque_n_m: some(2.0 / 3.0, 1.2e-3),
        positive_dead_zone_v: some(0.75, 0.35),
        negative_dead_zone_v: some(0.75, 0.35),
        cable_stiffness_n_m_rad: some(2.0 / 3.0, 2e-3),
        cable_rest_rad: some(1.0, 3.0) - 1.5,
        command_delay_s: some(2.0 / 3.0, 0.02),
        ..Nonidealities::default()
    };
    model
}
