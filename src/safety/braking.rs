use super::{BrakeLaw, CentringBrake, SpeedEnvelope};
use crate::qube::{MAX_VOLTAGE_V, State};

/// Volts against each rad/s of the arm: full voltage from 5 rad/s on, and below that gentle enough
/// not to ring through 20 ms of delay.
const GAIN_V_S: f64 = 1.0;

/// The voltage that brakes the arm. 0 V is not a stop: the arm coasts for 0.5 to 1.1 s.
#[must_use]
pub fn brake_voltage(theta_dot: f64) -> f64 {
    (-GAIN_V_S * theta_dot).clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
}

/// Volts against each rad/s of the arm while it is brought back: takes the pendulum's energy through
/// the arm fast, and strong enough for a Qube with a weak motor that crosses the middle.
const RETREAT_DAMPING_V_S: f64 = 0.5;

/// Volts towards the middle for each rad.
const RETREAT_CENTRING_V_RAD: f64 = 0.3;

/// Outside of this the way back gets steep, rad.
const WALL_RAD: f64 = 0.5;

/// Volts more for each rad outside of it.
const WALL_V_RAD: f64 = 8.0;

/// After this long, in control periods, the brake goes on with a share of its firmness: light and
/// strong Qubes may ring with a firm one through 20 ms of delay, and no Qube within 30 % with this.
const FIRM_PERIODS: u32 = 100;

/// That share.
const GENTLE: f64 = 0.45;

/// Full pushes against a momentum that leaves the envelope end after this long, in control periods:
/// to and fro they would keep some Qubes' pendulums swinging for good.
const PUSHING_PERIODS: u32 = 150;

/// A full push the other way within so many control periods of the last one means that the first has
/// overshot: a Qube as strong as that is stopped without full pushes.
const OVERSHOT_PERIODS: u32 = 20;

/// The brake of the speed envelope: stops the arm and brings it back to the middle.
///
/// At first, while arm and pendulum hold a momentum that leaves the envelope, it pushes against that at
/// full voltage, whoever of the two holds it. Otherwise it is a damper and a spring on the arm alone, steep
/// far out: it can only take energy, whatever the masses and lengths are. A brake against the arm's
/// velocity alone leaves the arm where the pendulum throws it next; feedback of the pendulum
/// would calm a nominal Qube sooner and drives one with another recoil faster and faster.
#[derive(Clone, Copy, Debug, Default)]
pub struct Retreat {
    /// Direction of the last full push, 0 before the first.
    push: f64,
    periods_since_push: u32,
    periods: u32,
    /// Whether full pushes are over.
    without_pushes: bool,
    /// How much sooner than a nominal Qube's the nearer stop comes, rad.
    room_rad: f64,
}

impl Retreat {
    /// The brake of a Qube whose nearer stop comes so much sooner than a nominal one's, rad.
    #[must_use]
    pub fn with_room(room_rad: f64) -> Self {
        Self { room_rad, ..Self::default() }
    }

    /// From now on without full pushes: where the pendulum's encoder cannot be believed.
    pub fn disbelieve_pendulum(&mut self) {
        self.without_pushes = true;
    }

    /// The voltage for the next control period, V.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        self.periods = self.periods.saturating_add(1);
        self.periods_since_push = self.periods_since_push.saturating_add(1);
        let push = -SpeedEnvelope::outward(state, self.room_rad);
        if push != 0.0 {
            let late = self.periods > PUSHING_PERIODS;
            let overshot = push == -self.push && self.periods_since_push <= OVERSHOT_PERIODS;
            self.without_pushes |= late || overshot;
            if !self.without_pushes {
                self.push = push;
                self.periods_since_push = 0;
                return push * MAX_VOLTAGE_V;
            }
        }
        let firmness = if self.periods > FIRM_PERIODS { GENTLE } else { 1.0 };
        let beyond_rad = (state.theta.abs() - WALL_RAD).max(0.0).copysign(state.theta);
        let wanted_v = -firmness
            * (RETREAT_DAMPING_V_S * state.theta_dot
                + RETREAT_CENTRING_V_RAD * state.theta
                + WALL_V_RAD * beyond_rad);
        wanted_v.clamp(-MAX_VOLTAGE_V, MAX_VOLTAGE_V)
    }
}

/// The brake under foresight: stops the arm and brings it back to the middle, by the very law that was
/// tried before it was needed.
#[derive(Clone, Copy, Debug, Default)]
pub struct ForeseenBrake {
    law: CentringBrake,
    periods: u32,
}

/// After this long, in control periods, it goes on with a share of its firmness: longer than a
/// [`super::Foresight`] looks, and by then the arm is only to come to rest.
const FORESEEN_PERIODS: u32 = 150;

impl ForeseenBrake {
    /// The voltage for the next control period, V.
    #[must_use]
    pub fn voltage_v(&mut self, state: &State) -> f64 {
        self.periods = self.periods.saturating_add(1);
        let firmness = if self.periods > FORESEEN_PERIODS { GENTLE } else { 1.0 };
        firmness * self.law.voltage_v(state)
    }
}
