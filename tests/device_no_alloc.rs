//! Tests that `sample` and `act`, which run inside the tick, allocate nothing on a pty or in
//! process.

use std::sync::Arc;

use assert_no_alloc::{AllocDisabler, assert_no_alloc};
use qube_hil::clock::{Clock, MonotonicClock, VirtualClock};
use qube_hil::device::emulator::{EmulatedQube, EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, LinkFault, SerialLink};
use qube_hil::qube::Measurement;

#[global_allocator]
static ALLOCATOR: AllocDisabler = AllocDisabler;

/// The results of one tick: of its sample and of its act.
type TickResults = (Result<Measurement, LinkFault>, Result<(), LinkFault>);

/// Runs ticks that give the device enough or too little time to answer, with voltages inside and
/// outside its range; returns the results of the first tick.
fn tick_often(device: &mut dyn Device, clock: &dyn Clock) -> Option<TickResults> {
    let mut first = None;
    for patience_ns in [2_000_000_000, 0, 100_000, 2_000_000_000] {
        for voltage_mv in [100, -100, 6000] {
            let sample = device.sample(clock.now_ns() + patience_ns);
            let sampled_at_us = sample.map_or(0, |sample| sample.device_time_us);
            let acted = device.act(voltage_mv, sampled_at_us);
            first.get_or_insert((sample, acted));
        }
    }
    first
}

#[test]
fn a_tick_on_a_pty_does_not_allocate() {
    let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
    let port = qube.port().to_str().unwrap();
    let mut link = SerialLink::open(port, Arc::new(MonotonicClock)).unwrap();
    link.hello().unwrap();
    link.arm().unwrap();
    let first = assert_no_alloc(|| tick_often(&mut link, &MonotonicClock));
    // Only the sample is certain: on a busy computer the act may come too late.
    assert!(matches!(first, Some((Ok(_), _))), "{first:?}");
    drop(qube);
    assert_no_alloc(|| tick_often(&mut link, &MonotonicClock));
}

#[test]
fn a_tick_in_process_does_not_allocate() {
    for fault in [None, Some(EmulatorFault::Garble { every: 2 })] {
        let clock = VirtualClock::default();
        let settings = EmulatorSettings { fault, ..EmulatorSettings::default() };
        let mut link = SerialLink::in_process(settings, clock.clone());
        link.hello().unwrap_or_else(|error| panic!("{error}"));
        let armed = link.arm();
        let first = assert_no_alloc(|| tick_often(&mut link, &clock));
        if fault.is_none() {
            assert!(armed.is_ok(), "{armed:?}");
            assert!(matches!(first, Some((Ok(_), Ok(())))), "{first:?}");
        }
    }
}
