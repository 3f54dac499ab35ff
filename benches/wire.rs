//! Speed of the wire: a tick in virtual time, a round trip on a pty, and the codec alone.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use firmware_protocol::{Decoder, Reply, SampleReply};
use qube_hil::clock::{Clock, MonotonicClock, VirtualClock};
use qube_hil::device::emulator::{EmulatedQube, EmulatorSettings};
use qube_hil::device::{Device, SerialLink};

const TICK_NS: u64 = 10_000_000;

fn wire(criterion: &mut Criterion) {
    criterion.bench_function("encode and decode a sample reply", |bencher| {
        let mut decoder = Decoder::new();
        let reply = Reply::Sample(SampleReply { theta_counts: 77, ..SampleReply::default() });
        bencher.iter(|| {
            let encoded = black_box(&reply).encode(1);
            encoded.as_bytes().iter().find_map(|&byte| decoder.push(byte))
        });
    });

    criterion.bench_function("in process: sample and act, one 10 ms tick", |bencher| {
        let clock = VirtualClock::default();
        let mut link = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        link.hello().unwrap();
        link.arm().unwrap();
        bencher.iter(|| {
            let start_ns = clock.now_ns();
            let measurement = link.sample(start_ns + TICK_NS).unwrap();
            let voltage_mv = if measurement.theta_counts % 64 < 32 { 1000 } else { -1000 };
            link.act(voltage_mv, measurement.device_time_us).unwrap();
            clock.sleep_until(start_ns + TICK_NS);
        });
    });

    criterion.bench_function("pty: sample, round trip", |bencher| {
        let qube = EmulatedQube::spawn(EmulatorSettings::default()).unwrap();
        let port = qube.port().to_str().unwrap();
        let mut link = SerialLink::open(port, Arc::new(MonotonicClock)).unwrap();
        link.hello().unwrap();
        bencher.iter(|| link.sample(MonotonicClock.now_ns() + 1_000_000_000).unwrap());
    });
}

criterion_group!(benches, wire);
criterion_main!(benches);
