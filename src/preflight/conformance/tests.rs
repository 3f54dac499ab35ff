use firmware_protocol::{Decoder, NO_ACT_US, RefusalReason, Reply, SampleReply, StatusBits};

use super::*;
use crate::clock::{Nanoseconds, VirtualClock};
use crate::device::emulator::{EmulatorFault, EmulatorSettings};
use crate::device::{InProcessWire, Transport};

fn failures(fault: Option<EmulatorFault>) -> Vec<&'static str> {
    let clock = VirtualClock::default();
    let settings = EmulatorSettings { fault, ..EmulatorSettings::default() };
    let mut wire = InProcessWire::new(settings, clock.clone());
    let mut test_host = TestHost::new(&mut wire, &clock);
    CHECKS
        .iter()
        .filter_map(|check| match check.run(&mut test_host) {
            Ok(()) => None,
            Err(deviation) => {
                println!("{}: {deviation}", check.name);
                Some(check.name)
            }
        })
        .collect()
}

#[test]
fn the_emulator_conforms_in_virtual_time() {
    assert_eq!(failures(None), Vec::<&str>::new());
}

#[test]
fn a_device_that_does_not_conform_is_found() {
    assert_eq!(failures(Some(EmulatorFault::Silent { after_s: 0.0 })).len(), CHECKS.len());
    let absent = failures(Some(EmulatorFault::QubeAbsent { after_s: 0.0 }));
    assert!(absent.contains(&"hello") && absent.contains(&"arm"), "{absent:?}");
    // Without a Qube the protocol requires a refusal.
    assert!(!absent.contains(&"module-id"), "{absent:?}");
    assert!(
        !failures(Some(EmulatorFault::StallError { after_s: 0.0 })).contains(&"arm-clears-stall")
    );
    let version = failures(Some(EmulatorFault::WrongVersion));
    assert!(version.contains(&"hello") && version.contains(&"version-mismatch"), "{version:?}");
    assert!(!failures(Some(EmulatorFault::Garble { every: 7 })).is_empty());
}

/// A correct device whose replies `distort` changes. A reply for which `distort` returns `false` is
/// dropped.
struct Mutant {
    wire: InProcessWire,
    decoder: Decoder,
    distort: fn(&mut u16, &mut Reply) -> bool,
}

impl Transport for Mutant {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let mut byte = [0];
        while self.wire.read(&mut byte, deadline_ns)? > 0 {
            let Some(Ok(frame)) = self.decoder.push(byte[0]) else { continue };
            let (mut sequence, mut reply) = (frame.sequence, Reply::parse(&frame).unwrap());
            if (self.distort)(&mut sequence, &mut reply) {
                let encoded = reply.encode(sequence);
                let length = encoded.as_bytes().len();
                buffer[..length].copy_from_slice(encoded.as_bytes());
                return Ok(length);
            }
        }
        Ok(0)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        self.wire.write(bytes)
    }

    fn name(&self) -> &str {
        "mutant"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.wire.boot_time_ns()
    }
}

fn refuses(reply: &Reply, which: RefusalReason) -> bool {
    matches!(reply, Reply::Refusal { reason, .. } if *reason == which)
}

fn distort_sample(reply: &mut Reply, distort: fn(&mut SampleReply)) -> bool {
    if let Reply::Sample(sample) = reply {
        distort(sample);
    }
    true
}

type Distortion = fn(&mut u16, &mut Reply) -> bool;

/// Mistakes that another implementation may make, each with the name of the check that must find
/// it.
const DISTORTIONS: &[(&str, Distortion)] = &[
    ("hello", |_, reply| {
        if let Reply::Hello(hello) = reply {
            hello.module_id = 0xFFFF;
        }
        true
    }),
    ("module-id", |_, reply| {
        if let Reply::Hello(hello) = reply {
            hello.module_id = 0xFFFF;
        }
        true
    }),
    ("boot-id", |_, reply| {
        if let Reply::Hello(hello) = reply {
            hello.boot_id = hello.nonce as u16;
        }
        true
    }),
    ("counts-continue", |_, reply| {
        distort_sample(reply, |sample| {
            if sample.status.has(StatusBits::ARMED) {
                sample.theta_counts += 5000;
            }
        })
    }),
    ("last-act-before-arm", |_, reply| {
        distort_sample(reply, |sample| sample.last_act_sequence |= 1)
    }),
    ("arm-clears-stall", |_, reply| {
        distort_sample(reply, |sample| sample.status.0 |= StatusBits::STALL_ERROR)
    }),
    ("stale-sample", |_, reply| !refuses(reply, RefusalReason::StaleSample)),
    ("watchdog-not-fed-by-stale", |_, reply| !refuses(reply, RefusalReason::StaleSample)),
    ("sample", |_, reply| distort_sample(reply, |sample| sample.device_time_us &= !0xFFFF)),
    ("fresh-nonce", |_, reply| {
        if let Reply::Hello(hello) = reply {
            hello.nonce = 1;
        }
        true
    }),
    ("sample", |_, reply| distort_sample(reply, |sample| sample.status.0 |= 0x80)),
    ("device-clock", |_, reply| {
        distort_sample(reply, |sample| {
            sample.device_time_us -= sample.device_time_us / 20;
        })
    }),
    ("replayed-arm", |_, reply| !refuses(reply, RefusalReason::WrongNonce)),
    ("arm-twice", |_, reply| !refuses(reply, RefusalReason::AlreadyArmed)),
    ("act-unarmed", |_, reply| !refuses(reply, RefusalReason::NotArmed)),
    ("act", |_, reply| distort_sample(reply, |sample| sample.applied_mv /= 2)),
    ("act", |_, reply| distort_sample(reply, |sample| sample.sample_to_act_us = 0xFFFF)),
    ("act", |_, reply| distort_sample(reply, |sample| sample.last_act_sequence ^= 1)),
    ("first-act-time", |_, reply| {
        // The device reports the time of the last act, which is later by the wait between the first
        // act and the last.
        distort_sample(reply, |sample| {
            if sample.sample_to_act_us != NO_ACT_US {
                sample.sample_to_act_us += 5000;
            }
        })
    }),
    ("act-out-of-range", |_, reply| !refuses(reply, RefusalReason::VoltageOutOfRange)),
    ("replayed-act", |_, reply| !refuses(reply, RefusalReason::StaleSequence)),
    ("watchdog", |_, reply| distort_sample(reply, |sample| sample.device_time_us *= 2)),
    ("watchdog-after-arm", |_, reply| {
        // The clock stands still, and the watchdog with it.
        distort_sample(reply, |sample| {
            (sample.device_time_us, sample.status) = (7, StatusBits(StatusBits::ARMED));
        })
    }),
    ("watchdog-latch", |_, reply| !refuses(reply, RefusalReason::WatchdogTripped)),
    ("garbage", |_, reply| {
        if let Reply::Hello(hello) = reply {
            hello.dropped_frames = 0;
        }
        true
    }),
    ("unknown-type", |_, reply| !refuses(reply, RefusalReason::UnknownType)),
    ("unknown-type", |_, reply| !refuses(reply, RefusalReason::WrongLength)),
    ("back-to-back", |sequence, reply| {
        if matches!(reply, Reply::Disarm(_)) {
            *sequence = sequence.wrapping_sub(1);
        }
        true
    }),
];

#[test]
fn each_wrong_answer_is_found_by_the_check_for_it() {
    for (index, (name, distort)) in DISTORTIONS.iter().enumerate() {
        let clock = VirtualClock::default();
        let wire = InProcessWire::new(EmulatorSettings::default(), clock.clone());
        let mut mutant = Mutant { wire, decoder: Decoder::new(), distort: *distort };
        let mut test_host = TestHost::new(&mut mutant, &clock);
        let check = CHECKS.iter().find(|check| check.name == *name).unwrap();
        let result = check.run(&mut test_host);
        assert!(
            result.is_err() && result != Err(Deviation::Disturbed),
            "distortion {index} passed {name}: {result:?}"
        );
    }
}

#[test]
fn names_are_unique() {
    let mut names: Vec<_> = CHECKS.iter().map(|check| check.name).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), CHECKS.len());
}
