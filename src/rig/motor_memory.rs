use std::sync::{Arc, Mutex, PoisonError};

use crate::clock::Nanoseconds;
use crate::safety::{LARGEST_LOAD, MotorHeat};

/// The heat that a Qube's motor had when its last rig was closed. All clones share it, so that a
/// rig that is opened anew by the same program begins with the warm motor's heat.
#[derive(Clone, Debug, Default)]
pub struct MotorMemory(Arc<Mutex<Option<ClosedRig>>>);

#[derive(Clone, Copy, Debug)]
struct ClosedRig {
    load: f64,
    closed_ns: Nanoseconds,
}

impl MotorMemory {
    /// Stores the heat of the motor of a rig that is closed at this time. `None`, if the control
    /// thread has ended and the heat is unknown, counts as the largest load.
    pub(super) fn store(&self, heat: Option<MotorHeat>, closed_ns: Nanoseconds) {
        let load = heat.map_or(LARGEST_LOAD, |heat| heat.load);
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) =
            Some(ClosedRig { load, closed_ns });
    }

    /// The motor's heat at this time: `cold` with the load that remains from the last closed rig,
    /// or `cold` itself if no rig was closed before.
    pub(super) fn warm(&self, cold: MotorHeat, now_ns: Nanoseconds) -> MotorHeat {
        let closed = *self.0.lock().unwrap_or_else(PoisonError::into_inner);
        closed.map_or(cold, |ClosedRig { load, closed_ns }| {
            let off_ns = now_ns.saturating_sub(closed_ns);
            MotorHeat { load, ..cold }.cooled(off_ns as f64 * 1e-9)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::emulator::{EmulatedQube, EmulatorSettings};
    use crate::rig::{ClockChoice, DeviceChoice, Rig, RigSettings};

    #[test]
    fn a_motor_cools_between_two_rigs_and_an_unknown_heat_counts_as_overheated() {
        let (memory, cold) = (MotorMemory::default(), MotorHeat::default());
        assert_eq!(memory.warm(cold, 5), cold);
        let warm = MotorHeat { load: 0.6, ..cold };
        memory.clone().store(Some(warm), 1_000_000_000);
        assert_eq!(memory.warm(cold, 1_000_000_000), warm);
        assert_eq!(memory.warm(cold, 11_000_000_000), warm.cooled(10.0));
        memory.store(None, 0);
        assert!(memory.warm(cold, 0).is_overheated());
    }

    #[test]
    fn a_rig_that_is_opened_anew_remembers_the_heat_of_its_motor() {
        let emulator = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
        let port = emulator.port().to_string_lossy().into_owned();
        let settings = RigSettings {
            clock: ClockChoice::Wall,
            ..RigSettings::in_virtual_time(DeviceChoice::Port(port))
        };
        let stop = Arc::default();
        let rig = Rig::connect(&settings, &stop).unwrap();
        let cold = rig.control.motor_heat().unwrap();
        assert_eq!(cold.load, 0.0);
        rig.control.set_motor(MotorHeat { load: 0.6, ..cold }).unwrap();
        drop(rig);
        let load = Rig::connect(&settings, &stop).unwrap().control.motor_heat().unwrap().load;
        assert!(load > 0.0 && load < 0.6, "{load}");
        let other = RigSettings { recovery: Default::default(), ..settings };
        assert_eq!(Rig::connect(&other, &stop).unwrap().control.motor_heat().unwrap().load, 0.0);
    }
}
