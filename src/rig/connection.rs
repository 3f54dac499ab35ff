use std::sync::Arc;

use super::{ClockChoice, DeviceChoice, RigError, RigSettings};
use crate::clock::{Clock, PunctualClock, VirtualClock};
use crate::device::emulator::EmulatedQube;
use crate::device::{Device, HilLink, SerialLink};

/// A device, its clock, and the running emulator if the device is an emulator behind a
/// pseudo-terminal.
type Connection = (Box<dyn Device>, Arc<dyn Clock>, Option<EmulatedQube>);

/// Opens the device that the settings choose.
pub(super) fn connect(settings: &RigSettings) -> Result<Connection, RigError> {
    match (&settings.device, settings.clock) {
        (DeviceChoice::Other(other), _) => {
            let (device, clock) = other.connect(&settings.emulator)?;
            Ok((device, clock, None))
        }
        (DeviceChoice::Emulated, ClockChoice::Virtual) => {
            let clock = VirtualClock::default();
            let link = SerialLink::in_process(settings.emulator, clock.clone());
            Ok((Box::new(link), Arc::new(clock), None))
        }
        (DeviceChoice::Emulated, ClockChoice::Wall) => {
            let emulator = EmulatedQube::spawn(settings.emulator).map_err(RigError::Emulator)?;
            let clock: Arc<dyn Clock> = Arc::new(PunctualClock::new());
            let port = emulator.port().to_string_lossy().into_owned();
            let link = SerialLink::open(&port, Arc::clone(&clock))?;
            Ok((Box::new(link), clock, Some(emulator)))
        }
        (DeviceChoice::Port(port), ClockChoice::Wall) => {
            let clock: Arc<dyn Clock> = Arc::new(PunctualClock::new());
            Ok((Box::new(SerialLink::open(port, Arc::clone(&clock))?), clock, None))
        }
        (DeviceChoice::Hil(address), ClockChoice::Wall) => {
            let clock: Arc<dyn Clock> = Arc::new(PunctualClock::new());
            Ok((Box::new(HilLink::open(address, Arc::clone(&clock))?), clock, None))
        }
        (DeviceChoice::Port(port), ClockChoice::Virtual) => {
            Err(RigError::VirtualPort { port: port.clone() })
        }
        (DeviceChoice::Hil(address), ClockChoice::Virtual) => {
            Err(RigError::VirtualPort { port: address.to_string() })
        }
    }
}
