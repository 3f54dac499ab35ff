//! The motor's heat from one motion to the next.

use std::sync::atomic::{AtomicBool, Ordering};

use crate::clock::{Clock, Nanoseconds};
use crate::safety::MotorHeat;

/// Interval at which a cooling pause checks for a request to stop, ns.
const COOLING_STEP_NS: Nanoseconds = 100_000_000;

/// The motor's heat between motions.
#[derive(Debug, Default)]
pub(super) struct MotorCooling {
    pub heat: MotorHeat,
    /// Time up to which `heat` is computed and since which the motor has had no current, ns; `None`
    /// before the first motion.
    off_since_ns: Option<Nanoseconds>,
}

impl MotorCooling {
    /// A motor with this heat whose current ends now.
    pub fn off_from_now(heat: MotorHeat, clock: &dyn Clock) -> Self {
        Self { heat, off_since_ns: Some(clock.now_ns()) }
    }

    /// Notes that the current ends now.
    pub fn switched_off(&mut self, clock: &dyn Clock) {
        self.off_since_ns = Some(clock.now_ns());
    }

    /// Cools the motor for the time without current since the last update.
    pub fn cool(&mut self, clock: &dyn Clock) {
        if let Some(off_since_ns) = &mut self.off_since_ns {
            let now_ns = clock.now_ns();
            let off_ns = now_ns.saturating_sub(*off_since_ns);
            self.heat = self.heat.cooled(off_ns as f64 * 1e-9);
            *off_since_ns = now_ns;
        }
    }

    /// Waits with the amplifier off until the motor is cool enough for the next motion or `stop` is
    /// set.
    pub fn cool_down(&mut self, clock: &dyn Clock, stop: &AtomicBool) {
        self.cool(clock);
        let cooling_ns = (self.heat.cooling_s() * 1e9) as Nanoseconds;
        let end_ns = clock.now_ns().saturating_add(cooling_ns);
        while clock.now_ns() < end_ns && !stop.load(Ordering::Relaxed) {
            clock.sleep_until(end_ns.min(clock.now_ns() + COOLING_STEP_NS));
            self.cool(clock);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::VirtualClock;
    use crate::safety::COOLED_LOAD;

    #[test]
    fn a_hot_motor_cools_down_before_the_next_motion_unless_a_stop_is_asked_for() {
        let clock = VirtualClock::default();
        let heat = MotorHeat { load: 0.85, ..MotorHeat::default() };
        let mut motor = MotorCooling { heat, off_since_ns: Some(0) };
        motor.cool_down(&clock, &AtomicBool::new(false));
        assert!((motor.heat.load - COOLED_LOAD).abs() < 1e-3, "{motor:?}");
        let waited_s = clock.now_ns() as f64 * 1e-9;
        assert!((waited_s - heat.cooling_s()).abs() < 1e-3, "{waited_s} s");

        let now_ns = clock.now_ns();
        let mut motor = MotorCooling { heat, off_since_ns: Some(now_ns) };
        motor.cool_down(&clock, &AtomicBool::new(true));
        assert_eq!((clock.now_ns(), motor.heat), (now_ns, heat));
    }
}
