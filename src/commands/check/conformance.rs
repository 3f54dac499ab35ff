use std::sync::Arc;

use serde_json::json;

use crate::clock::{Clock, MonotonicClock, VirtualClock};
use crate::commands::check_table::{Row, checks_json, failed_names, table};
use crate::commands::chosen_device::ChosenDevice;
use crate::commands::exit::Failure;
use crate::commands::output::Output;
use crate::commands::printable::print_message;
use crate::commands::stop::Stop;
use crate::device::emulator::{EmulatedQube, EmulatorSettings};
use crate::device::{DeviceError, InProcessWire, LinkFault, Transport, Tty};
use crate::preflight::conformance::{CHECKS, Deviation, TestHost};
use crate::rig::{ClockChoice, DeviceChoice, RigError};
use crate::telemetry::{CheckResult, Fault};

/// A connection that carries raw bytes, because the checks write and read the frames of the
/// protocol themselves.
struct Wire {
    transport: Box<dyn Transport>,
    clock: Arc<dyn Clock>,
    /// Emulated Qube behind the connection, which must exist until the last check is done.
    _emulator: Option<EmulatedQube>,
}

/// Performs all conformance checks of a device and prints the results.
pub fn run(device: &ChosenDevice, output: &Output) -> Result<(), Failure> {
    let stop = Stop::on_signals()?;
    let mut wire = open(device)?;
    let port = wire.transport.name().to_owned();
    let clock = Arc::clone(&wire.clock);
    let mut host = TestHost::new(wire.transport.as_mut(), clock.as_ref());
    print_message(&format!("{} checks of the device at {port}", CHECKS.len()));

    let mut results = Vec::new();
    for check in CHECKS {
        if stop.requested() {
            return Err(stop.failure("stopped; the motor is off"));
        }
        let result = check.run(&mut host);
        if results.is_empty() && matches!(result, Err(Deviation::Silent("Hello"))) {
            return Err(Failure::usage(DeviceError::NotAQube {
                port,
                reason: "no answer to a hello".into(),
            }));
        }
        if result == Err(Deviation::Link(LinkFault::Gone)) {
            let gone = DeviceError::Link { port, fault: LinkFault::Gone };
            // The checks before this one had the motor on.
            return Err(match results.is_empty() {
                true => Failure::usage(gone),
                false => Failure::fault(gone).caused_by(Some(Fault::LinkGone)),
            });
        }
        results.push(match result {
            Ok(()) => CheckResult::pass(check.name, ""),
            Err(deviation) => CheckResult::fail(check.name, deviation.to_string(), check.promise),
        });
    }

    let rows: Vec<Row> = results.iter().map(row).collect();
    let passed = results.iter().filter(|result| !result.failed()).count();
    let summary = format!("{passed} of {} checks passed", results.len());
    let text = format!("{}{summary}\n", table(&rows));
    output.print(&text, &json!({ "port": port, "checks": checks_json(&results) }));
    if passed < results.len() {
        return Err(Failure::failed(format!(
            "{port} does not conform to PROTOCOL.md: {} failed",
            failed_names(&results)
        )));
    }
    Ok(())
}

/// Returns the row of a check in the table. In place of a remedy it shows the protocol's
/// requirement.
fn row(result: &CheckResult) -> Row {
    let promise = result.remedy.clone();
    Row { remedy: promise.map(|promise| ("must be:", promise)), ..Row::from(result) }
}

fn open(device: &ChosenDevice) -> Result<Wire, Failure> {
    let settings = EmulatorSettings::default();
    match (&device.choice, device.clock) {
        (DeviceChoice::Emulated, ClockChoice::Virtual) => {
            let clock = VirtualClock::default();
            let transport = Box::new(InProcessWire::new(settings, clock.clone()));
            Ok(Wire { transport, clock: Arc::new(clock), _emulator: None })
        }
        (DeviceChoice::Emulated, ClockChoice::Wall) => {
            let emulator = EmulatedQube::spawn(settings)
                .map_err(|error| Failure::failed(RigError::Emulator(error)))?;
            let port = emulator.port().to_string_lossy().into_owned();
            Ok(Wire { _emulator: Some(emulator), ..open_port(&port)? })
        }
        (DeviceChoice::Port(port), ClockChoice::Wall) => open_port(port),
        (DeviceChoice::Port(port), ClockChoice::Virtual) => {
            Err(Failure::usage(RigError::VirtualPort { port: port.clone() }))
        }
        (DeviceChoice::Hil(address), _) => Err(Failure::usage(format!(
            "--conformance tests a board's firmware, and {address} has the vendor's. Leave --conformance out"
        ))),
        (DeviceChoice::Other(_), _) => {
            Err(Failure::usage("only a port or the emulated Qube can be tested in this way"))
        }
    }
}

fn open_port(port: &str) -> Result<Wire, Failure> {
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock);
    let tty = Tty::open(port, Arc::clone(&clock)).map_err(Failure::usage)?;
    Ok(Wire { transport: Box::new(tty), clock, _emulator: None })
}
