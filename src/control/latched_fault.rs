use std::sync::atomic::{AtomicUsize, Ordering};

use super::{ControlState, Motion, Tick, TickInput, TickOutput};
use crate::policy::Controller;
use crate::safety::{Contradiction, Foreseen};
use crate::telemetry::Fault;

/// A fault that a rollout has latched and that other threads can see while the arm is being damped
/// or braked, which takes up to 15 s. The rig stores the doubt that the fault leaves, so that the
/// doubt stays even if the program is killed meanwhile.
#[derive(Debug, Default)]
pub(super) struct LatchedFault {
    /// Place of the fault in [`Fault::ALL`], from 1; 0 without a fault.
    number: AtomicUsize,
}

impl LatchedFault {
    /// The fault, if there is one.
    pub fn get(&self) -> Option<Fault> {
        let number = self.number.load(Ordering::Relaxed);
        Fault::ALL.get(number.checked_sub(1)?).copied()
    }

    fn set(&self, fault: Option<Fault>) {
        let place = fault.and_then(|fault| Fault::ALL.iter().position(|it| *it == fault));
        self.number.store(place.map_or(0, |place| place + 1), Ordering::Relaxed);
    }
}

/// A rollout that, after each tick, shows other threads the fault that it has latched, if any. This
/// neither locks nor allocates.
pub(super) struct ShownRollout<'a, C> {
    tick: Tick<C>,
    latched: &'a LatchedFault,
}

impl<'a, C: Controller> ShownRollout<'a, C> {
    /// A rollout that begins without a fault.
    pub fn new(tick: Tick<C>, latched: &'a LatchedFault) -> Self {
        latched.set(None);
        Self { tick, latched }
    }
}

impl<C: Controller> Motion for ShownRollout<'_, C> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        let output = self.tick.decide(input);
        if let Some(fault) = self.tick.latched_fault()
            && self.latched.get().is_none()
        {
            self.latched.set(Some(fault));
        }
        output
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.tick.device_mv(voltage_mv)
    }

    fn control_state(&self) -> ControlState {
        self.tick.control_state()
    }

    fn observer_resets(&self) -> u32 {
        self.tick.observer_resets()
    }

    fn foreseen(&self) -> Option<Foreseen> {
        self.tick.foreseen()
    }

    fn contradiction(&self) -> Option<Contradiction> {
        self.tick.contradiction()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fault_is_seen_as_it_was_latched() {
        let latched = LatchedFault::default();
        assert_eq!(latched.get(), None);
        for &fault in Fault::ALL {
            latched.set(Some(fault));
            assert_eq!(latched.get(), Some(fault));
        }
        latched.set(None);
        assert_eq!(latched.get(), None);
    }
}
