//! Tests that the emulated Qube passes every check of conformance over a real pty, too.

use std::sync::Arc;

use qube_hil::clock::MonotonicClock;
use qube_hil::device::Tty;
use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings};
use qube_hil::preflight::conformance::{CHECKS, TestHost};

#[test]
fn the_emulator_conforms_over_a_pty() {
    let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
    let mut tty = Tty::open(qube.port().to_str().unwrap(), Arc::new(MonotonicClock)).unwrap();
    let mut host = TestHost::new(&mut tty, &MonotonicClock);
    for check in CHECKS {
        if let Err(deviation) = check.run(&mut host) {
            panic!("{} ({}): {deviation}", check.name, check.promise);
        }
    }
}
