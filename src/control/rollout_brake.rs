//! The brake of a rollout: the voltage, the law by which it works, and its end.

use super::ControlEvent;
use super::brake_end::{ArmAfterBrake, BrakeEnd, BrakeKind};
use super::rules_of_recordings::{brake_of, damping_brake};
use crate::elementary::Scalar;
use crate::qube::{MAX_HISTORY, State};
use crate::safety::{Brake, TrustedForesight, clamp_to_mv};
use crate::telemetry::{Ending, Fault, Phase, TickRules, TickSettings};

/// Shares of the brake's voltage that foresight tries in turn. The negative share is for an arm
/// that, after lost samples, already moves against its estimated velocity.
const BRAKE_SHARES: [f64; 4] = [1.0, 0.25, 0.0, -1.0];

/// Periods of braking within which a jump of the pendulum's count counts as the reason for the
/// braking. A jump is recognised one sample later than the guard acts on it.
const JUMP_KNOWN_TICKS: u32 = 2;

/// Returns whether the pendulum is nearer to upright than to hanging. Once it falls, it moves an
/// arm whose motor is off.
fn is_upright(state: &State) -> bool {
    Scalar::sin_cos(state.alpha).1 < 0.0
}

/// The brake of a rollout.
#[derive(Debug)]
pub(super) struct RolloutBrake {
    rules: TickRules,
    largest_voltage_v: f64,
    brake: Brake,
    /// True if the brake uses the arm's velocity alone, because the arm's count is doubted.
    damps: bool,
    end: BrakeEnd,
}

impl RolloutBrake {
    /// The brake of a rollout with these settings, before its first period.
    pub fn of(settings: &TickSettings) -> Self {
        Self {
            rules: settings.rules,
            largest_voltage_v: settings.plant.limits.largest_voltage_v,
            brake: brake_of(settings),
            damps: false,
            end: BrakeEnd::of(settings),
        }
    }

    /// Begins to brake: settling may have used the brake before.
    pub fn begin(&mut self, settings: &TickSettings) {
        self.brake = if self.damps { damping_brake(settings) } else { brake_of(settings) };
    }

    /// Uses the arm's velocity alone from now on, because the arm's count is doubted.
    pub fn damp(&mut self, settings: &TickSettings) {
        if !self.damps {
            self.damps = true;
            self.brake = damping_brake(settings);
        }
    }

    /// Returns whether the brake uses the arm's velocity alone.
    pub fn damps(&self) -> bool {
        self.damps
    }

    /// Returns whether an arm whose count is doubted in this phase is damped by its velocity
    /// instead of being left alone.
    ///
    /// The count may be right although a test doubts it; with the motor off, a moving arm would
    /// then coast into its stop. For an arm at rest the brake gives 0 V anyway.
    pub fn may_damp(&self, phase: Phase) -> bool {
        if phase == Phase::Settling {
            self.rules.damps_while_settling()
        } else {
            self.rules.damps_doubted_count()
        }
    }

    /// Returns whether this fault, which shows only while the arm is braked, voids the rollout;
    /// the brake began `periods` ago for `ending`. A step of the pendulum's count is known to be a
    /// jump only one sample after box or foresight began to brake for it. A constant count of the
    /// pendulum is known to be frozen only once the arm has accelerated, and the policy may have
    /// seen it for long.
    pub fn is_voided_by(&self, fault: Fault, periods: u32, ending: Ending) -> bool {
        match fault {
            Fault::PendulumJump => {
                self.rules.explains_brake_by_jump()
                    && periods <= JUMP_KNOWN_TICKS
                    && matches!(ending, Ending::LeftBox(_))
            }
            Fault::PendulumFrozen => self.rules.voids_frozen_pendulum(),
            _ => false,
        }
    }

    /// The event that ends braking after `periods` periods, with the ending that it gives: the arm
    /// has stopped, the time for braking is over, or the arm does not obey the motor. `ending` is
    /// the ending for which the rollout is braked.
    pub fn end(
        &mut self,
        arm: &State,
        periods: u32,
        ending: Ending,
    ) -> Option<(ControlEvent, Ending)> {
        let kind = if self.damps { BrakeKind::Damping } else { BrakeKind::Guarded };
        let pendulum_is_doubted =
            matches!(ending, Ending::Fault(Fault::PendulumFrozen | Fault::PendulumJump));
        let waits = self.rules.waits_for_pendulum() && !pendulum_is_doubted && is_upright(arm);
        Some(match self.end.check(arm, periods, kind, waits)? {
            ArmAfterBrake::Stopped => (ControlEvent::BrakingEnded, ending),
            ArmAfterBrake::Disobeys => {
                (ControlEvent::SwitchOffFault, Ending::Fault(Fault::BrakingTimedOut))
            }
        })
    }

    /// The voltage of the brake, V, times the first of `BRAKE_SHARES` for which foresight finds
    /// that no simulated Qube's arm hits its stop. `sent_v` are the voltages sent in the last
    /// periods, newest first, V.
    ///
    /// A firm brake whose voltage is held while samples are lost may throw a light arm back. The
    /// simulation assumes that the velocity is as exact as without lost samples. With the larger
    /// error of a velocity after lost samples, no share would pass when the test matters most. If
    /// no share passes, the brake's full voltage is returned. It is also returned under the rules
    /// before [`TickRules::BrakeSimulating`], without foresight, and while the arm's count is
    /// doubted.
    pub fn voltage_v(
        &mut self,
        arm: &State,
        sent_v: &[f32; MAX_HISTORY],
        foresight: Option<&mut TrustedForesight>,
    ) -> f64 {
        let wanted_v = self.brake.voltage_v(arm);
        let simulates = self.rules.simulates_brake() && !self.damps;
        let Some(foresight) = foresight.filter(|_| simulates) else { return wanted_v };
        foresight.trust_velocities();
        let arm = arm.cast();
        let mut passes = |share: &f64| {
            clamp_to_mv(share * wanted_v, self.largest_voltage_v).is_ok_and(|voltage_mv| {
                let voltage_v = f32::from(voltage_mv) * 1e-3;
                foresight.too_late_for(&arm, sent_v, voltage_v).is_none()
            })
        };
        BRAKE_SHARES.into_iter().find(|share| passes(share)).unwrap_or(1.0) * wanted_v
    }
}
