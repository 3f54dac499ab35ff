use firmware_protocol::{DeviceState, PROTOCOL_VERSION};

use super::*;
use crate::clock::VirtualClock;
use crate::device::InProcessWire;
use crate::device::emulator::{EmulatorFault, EmulatorSettings};

fn link(fault: Option<EmulatorFault>) -> (SerialLink<InProcessWire>, VirtualClock) {
    let clock = VirtualClock::default();
    let settings = EmulatorSettings { fault, seed: 7, ..EmulatorSettings::default() };
    (SerialLink::in_process(settings, clock.clone()), clock)
}

fn armed(fault: Option<EmulatorFault>) -> (SerialLink<InProcessWire>, VirtualClock) {
    let (mut link, clock) = link(fault);
    link.hello().unwrap();
    link.arm().unwrap();
    (link, clock)
}

fn sample(link: &mut SerialLink<InProcessWire>, clock: &VirtualClock) -> Measurement {
    link.sample(clock.now_ns() + 10 * MS).unwrap()
}

#[test]
fn the_hello_names_the_emulator() {
    let identity = link(None).0.hello().unwrap();
    assert_eq!(identity.kind, "emulator");
    assert_eq!(identity.serial, "0000000000000007");
    assert_eq!(identity.firmware_version, env!("CARGO_PKG_VERSION"));
    assert_eq!(identity.protocol_version, PROTOCOL_VERSION);
}

#[test]
fn acts_turn_the_arm_and_show_in_the_next_sample() {
    let (mut link, clock) = armed(None);
    let start = sample(&mut link, &clock);
    assert_eq!((start.applied_mv, start.sample_to_act_us), (0, None));
    let start_ns = clock.now_ns();
    let mut last = start;
    for tick in 1..=20 {
        link.act(2000, last.device_time_us).unwrap();
        clock.sleep_until(start_ns + tick * 10 * MS);
        last = sample(&mut link, &clock);
        assert!(last.status.armed);
        assert_eq!(last.applied_mv, 1994);
        // The line takes a turnaround of 100 us, a reply of 640 us and an act of 260 us.
        assert_eq!(last.sample_to_act_us, Some(1000));
    }
    // After the first reading of the encoders its reply takes 740 us; 200 ms later the last request
    // takes 140 us.
    assert_eq!(last.device_time_us - start.device_time_us, 200_000 + 740 + 140);
    assert!(last.theta_counts - start.theta_counts > 100);
    assert!(last.tachometer_counts_s > 0);
}

#[test]
fn the_watchdog_trips_and_only_hello_and_arm_leave_the_tripped_state() {
    let (mut link, clock) = armed(None);
    let start = sample(&mut link, &clock);
    link.act(1000, start.device_time_us).unwrap();
    clock.advance(60 * MS);
    let tripped = sample(&mut link, &clock);
    assert!(tripped.status.watchdog_tripped && !tripped.status.armed);
    assert_eq!(tripped.applied_mv, 0);
    assert_eq!(link.act(1000, tripped.device_time_us), Err(LinkFault::WatchdogTripped));
    link.disarm().unwrap();
    assert!(matches!(link.arm(), Err(DeviceError::Refused { action: "arm", .. })));
    link.hello().unwrap();
    link.arm().unwrap();
    let again = sample(&mut link, &clock);
    assert!(again.status.armed && !again.status.watchdog_tripped);
}

#[test]
fn a_trip_or_fault_that_only_the_disarm_shows_is_the_reason_why_the_next_arm_is_refused() {
    let amplifier = EmulatorFault::AmplifierFault { after_s: 0.02 };
    for (fault, expected) in
        [(None, RefusalReason::WatchdogTripped), (Some(amplifier), RefusalReason::Faulted)]
    {
        let (mut link, clock) = armed(fault);
        sample(&mut link, &clock);
        clock.advance(60 * MS);
        link.disarm().unwrap();
        let refused = link.arm().unwrap_err();
        assert!(
            matches!(refused, DeviceError::Refused { reason, .. } if reason == expected),
            "{refused}"
        );
        link.hello().unwrap();
        assert_eq!(link.arm().is_ok(), fault.is_none());
    }
}

#[test]
fn an_amplifier_fault_that_is_over_before_the_next_sample_is_reported() {
    let fault = EmulatorFault::LapsingAmplifierFault { after_s: 0.02, lasts_s: 0.004 };
    let (mut link, clock) = armed(Some(fault));
    sample(&mut link, &clock);
    clock.advance(30 * MS);
    let status = sample(&mut link, &clock).status;
    assert!(status.amplifier_fault && !status.armed, "{status:?}");
    link.hello().unwrap();
    link.arm().unwrap();
    assert!(!sample(&mut link, &clock).status.amplifier_fault);
}

#[test]
fn a_device_that_says_that_it_stays_armed_has_not_switched_its_motor_off() {
    let (mut link, _) = armed(Some(EmulatorFault::IgnoredDisarm { after_s: 0.0 }));
    let refused = link.disarm().unwrap_err();
    assert!(matches!(refused, DeviceError::StaysArmed { .. }), "{refused}");
    let (mut link, clock) = armed(Some(EmulatorFault::IgnoredDisarm { after_s: 0.0 }));
    clock.advance(60 * MS);
    // The watchdog has switched the motor off.
    link.disarm().unwrap();
}

#[test]
fn a_disarmed_device_arms_again_without_a_hello() {
    let (mut link, clock) = armed(None);
    link.disarm().unwrap();
    let disarmed = sample(&mut link, &clock);
    assert!(!disarmed.status.armed);
    assert_eq!(link.act(1000, disarmed.device_time_us), Err(LinkFault::NotArmed));
    link.arm().unwrap();
    assert!(sample(&mut link, &clock).status.armed);
}

#[test]
fn arming_needs_a_hello() {
    assert!(matches!(link(None).0.arm(), Err(DeviceError::Refused { action: "arm", .. })));
}

#[test]
fn a_sample_waits_no_longer_than_its_deadline_and_a_late_reply_is_dropped() {
    let (mut link, clock) = armed(None);
    let first = sample(&mut link, &clock);
    let before_ns = clock.now_ns();
    let too_soon_ns = before_ns + 300_000;
    assert_eq!(link.sample(too_soon_ns), Err(LinkFault::Timeout));
    assert_eq!(clock.now_ns(), too_soon_ns);
    clock.advance(MS);
    let next = sample(&mut link, &clock);
    assert!(next.device_time_us > first.device_time_us + 1000);
}

#[test]
fn a_garbled_reply_is_a_timeout_and_the_next_one_is_read() {
    let (mut link, clock) = armed(Some(EmulatorFault::Garble { every: 5 }));
    let mut outcomes = Vec::new();
    for _ in 0..20 {
        let sample = link.sample(clock.now_ns() + 2 * MS);
        outcomes.push(sample.is_ok());
        if let Ok(sample) = sample {
            link.act(0, sample.device_time_us).unwrap();
        }
    }
    assert_eq!(outcomes.iter().filter(|is_ok| !**is_ok).count(), 4, "{outcomes:?}");
}

#[test]
fn a_device_that_is_not_a_qube_is_named() {
    let reason = |fault| match link(Some(fault)).0.hello() {
        Err(error) => error.to_string(),
        Ok(identity) => panic!("the hello was answered: {identity:?}"),
    };
    assert!(reason(EmulatorFault::Silent { after_s: 0.0 }).contains("no answer to 25 hellos"));
    assert!(reason(EmulatorFault::QubeAbsent { after_s: 0.0 }).contains("module id 0x0000"));
    assert!(
        reason(EmulatorFault::WrongVersion)
            .contains("uses protocol version 1, this program uses 2")
    );
    assert!(reason(EmulatorFault::Garble { every: 1 }).contains("bytes that are not an answer"));
    assert!(reason(EmulatorFault::Unplugged { after_s: 0.0 }).contains("the port is gone"));
}

#[test]
fn faults_of_the_qube_switch_the_motor_off_and_are_reported() {
    for (fault, clears) in [
        (EmulatorFault::AmplifierFault { after_s: 0.02 }, false),
        (EmulatorFault::StallError { after_s: 0.02 }, true),
    ] {
        let (mut link, clock) = armed(Some(fault));
        let start = sample(&mut link, &clock);
        link.act(3000, start.device_time_us).unwrap();
        clock.advance(20 * MS);
        let measurement = sample(&mut link, &clock);
        assert!(!measurement.status.armed && !measurement.status.watchdog_tripped);
        assert_eq!(measurement.applied_mv, 0);
        assert_eq!(measurement.status.amplifier_fault, !clears);
        assert_eq!(measurement.status.stall_error, clears);
        assert_eq!(link.act(3000, measurement.device_time_us), Err(LinkFault::NotArmed));
        link.hello().unwrap();
        assert_eq!(link.arm().is_ok(), clears);
    }
}

#[test]
fn a_frozen_encoder_stays_while_the_arm_moves() {
    let (mut link, clock) = armed(Some(EmulatorFault::FrozenAlpha { after_s: 0.0 }));
    let start = sample(&mut link, &clock);
    let mut moved = start;
    for _ in 0..20 {
        link.act(5000, moved.device_time_us).unwrap();
        clock.advance(10 * MS);
        moved = sample(&mut link, &clock);
        assert_eq!(moved.alpha_counts, start.alpha_counts);
    }
    assert_ne!(sample(&mut link, &clock).theta_counts, start.theta_counts);
}

#[test]
fn an_unplugged_port_is_gone() {
    let (mut link, clock) = armed(Some(EmulatorFault::Unplugged { after_s: 0.05 }));
    clock.sleep_until(45 * MS);
    let last = sample(&mut link, &clock);
    clock.sleep_until(50 * MS);
    assert_eq!(link.act(0, last.device_time_us), Err(LinkFault::Gone));
    assert_eq!(link.sample(clock.now_ns() + MS), Err(LinkFault::Gone));
}

#[test]
fn a_dropped_link_leaves_the_motor_off() {
    let clock = VirtualClock::default();
    let mut wire = InProcessWire::new(EmulatorSettings::default(), clock.clone());
    let mut link = SerialLink::new(&mut wire, Arc::new(clock.clone()));
    link.hello().unwrap();
    link.arm().unwrap();
    let start = link.sample(clock.now_ns() + 10 * MS).unwrap();
    link.act(3000, start.device_time_us).unwrap();
    drop(link);
    clock.advance(MS);
    assert_eq!(wire.board().state(), DeviceState::Greeted);
}

#[test]
fn device_time_goes_on_beyond_32_bits() {
    let mut time = DeviceTime::default();
    assert_eq!(time.unwrap_us(u32::MAX - 9), u64::from(u32::MAX) - 9);
    assert_eq!(time.unwrap_us(90), u64::from(u32::MAX) + 91);
    assert_eq!(time.unwrap_us(89), 2 * (u64::from(u32::MAX) + 1) + 89);
}

#[test]
fn an_act_on_a_sample_that_is_old_or_not_the_last_is_not_sent() {
    let (mut link, clock) = armed(None);
    let older = sample(&mut link, &clock);
    assert_eq!(link.act(1000, 0), Err(LinkFault::StaleSample));
    let last = sample(&mut link, &clock);
    assert_eq!(link.act(1000, older.device_time_us), Err(LinkFault::StaleSample));
    assert_eq!(link.act(1000, last.device_time_us + 1), Err(LinkFault::StaleSample));
    assert_eq!(link.act(1000, last.device_time_us), Ok(()));
    clock.advance(20 * MS);
    assert_eq!(link.act(2000, last.device_time_us), Err(LinkFault::StaleSample));
    assert_eq!(sample(&mut link, &clock).applied_mv, 1009);
    link.hello().unwrap();
    link.arm().unwrap();
    assert_eq!(link.act(1000, last.device_time_us), Err(LinkFault::StaleSample));
}

#[test]
fn a_restart_shows_in_the_next_hello() {
    for (fault, dark_ms) in [
        (EmulatorFault::BrownOut { after_s: 0.5 }, 70),
        (EmulatorFault::BoardRestart { after_s: 0.5 }, 1000),
    ] {
        let (mut link, clock) = link(Some(fault));
        let before = link.hello().unwrap();
        assert!(before.is_same_start(&link.hello().unwrap()));
        clock.sleep_until(500 * MS);
        assert_eq!(link.sample(clock.now_ns() + 6 * MS), Err(LinkFault::Timeout));
        // A single call of `hello` waits until the device has booted.
        let after = link.hello().unwrap();
        assert!(clock.now_ns() >= (500 + dark_ms) * MS);
        assert!(before.is_same_board(&after) && !before.is_same_start(&after));
        link.arm().unwrap();
        assert!(sample(&mut link, &clock).device_time_us < 1_000_000);
    }
}

#[test]
fn a_device_that_restarted_refuses_samples_until_it_is_greeted() {
    let (mut link, clock) = armed(Some(EmulatorFault::BrownOut { after_s: 0.1 }));
    clock.advance(300 * MS);
    assert_eq!(link.sample(clock.now_ns() + 6 * MS), Err(LinkFault::Restarted));
    link.hello().unwrap();
    sample(&mut link, &clock);
}

#[test]
fn a_device_that_falls_silent_is_not_called_another_device() {
    let (mut link, clock) = armed(Some(EmulatorFault::Silent { after_s: 3.0 }));
    while clock.now_ns() < 4000 * MS {
        let _ = link.sample(clock.now_ns() + 10 * MS);
    }
    let error = link.hello().unwrap_err();
    let DeviceError::FellSilent { silent_s, .. } = error else { panic!("{error}") };
    // One second of unanswered samples, then 25 at intervals of 0.1 s before a hello.
    assert!((3.4..3.6).contains(&silent_s), "{error}");
    assert!(error.to_string().contains("no answer to 25 samples"), "{error}");
}

#[test]
fn an_emergency_stop_is_told_and_latched_until_a_new_link_finds_it_closed() {
    let renew = |link: &mut SerialLink<InProcessWire>| {
        (link.boot_id, link.seen) = (None, Seen::default());
    };
    let (mut link, clock) = armed(Some(EmulatorFault::EmergencyStop { after_s: 0.1 }));
    let before = sample(&mut link, &clock);
    assert!(before.status.stop_switch_fitted && !before.status.emergency_stop);
    link.act(3000, before.device_time_us).unwrap();
    clock.sleep_until(100 * MS);
    let stopped = sample(&mut link, &clock);
    assert!(stopped.status.emergency_stop && !stopped.status.armed);
    assert_eq!(stopped.applied_mv, 0);
    renew(&mut link);
    link.hello().unwrap();
    let refused = link.arm().unwrap_err();
    assert!(refused.to_string().contains("emergency-stop switch is or was open"), "{refused}");
    // This link has never seen the switch closed, so it does not count the switch as opened since
    // the first hello.
    link.hello().unwrap();
    assert!(sample(&mut link, &clock).status.emergency_stop);
    clock.sleep_until(2200 * MS);
    assert!(sample(&mut link, &clock).status.emergency_stop, "closing alone has cleared it");
    link.hello().unwrap();
    renew(&mut link);
    link.hello().unwrap();
    link.arm().unwrap();
    assert!(!sample(&mut link, &clock).status.emergency_stop);
}

/// A board that refuses each request.
struct Refuser {
    clock: VirtualClock,
    decoder: Decoder,
    answers: Vec<u8>,
}

impl Transport for Refuser {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let count = self.answers.len().min(buffer.len());
        if count == 0 {
            self.clock.sleep_until(deadline_ns);
        }
        for (place, answer) in buffer.iter_mut().zip(self.answers.drain(..count)) {
            *place = answer;
        }
        Ok(count)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        for frame in bytes.iter().filter_map(|byte| self.decoder.push(*byte)).flatten() {
            let (refused_type, reason) = (frame.message_type, RefusalReason::NotGreeted);
            let reply = Reply::Refusal { refused_type, reason }.encode(frame.sequence);
            self.answers.extend_from_slice(reply.as_bytes());
        }
        Ok(())
    }

    fn name(&self) -> &str {
        "refuser"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        1_000 * MS
    }
}

#[test]
fn a_device_that_refuses_hellos_gets_one_every_tenth_of_a_second() {
    let clock = VirtualClock::default();
    let refuser = Refuser { clock: clock.clone(), decoder: Decoder::new(), answers: Vec::new() };
    let refused = SerialLink::new(refuser, Arc::new(clock)).hello().unwrap_err();
    assert!(refused.to_string().contains("only refusals as answer to 10 hellos"), "{refused}");
}

#[test]
fn a_qube_that_was_switched_off_and_on_needs_a_new_hello() {
    for looks_in_between in [true, false] {
        let fault = EmulatorFault::SwitchedOffAndOn { after_s: 0.5, off_s: 1.0 };
        let (mut link, clock) = link(Some(fault));
        let identity = link.hello().unwrap();
        let mut sample_at = |time_ms: Nanoseconds| {
            clock.sleep_until(time_ms * MS);
            link.sample(clock.now_ns() + 10 * MS)
        };
        sample_at(400).unwrap();
        if looks_in_between {
            assert_eq!(sample_at(600), Err(LinkFault::QubeOff));
        }
        assert_eq!(sample_at(1600), Err(LinkFault::Restarted), "its counters go on");
        for _ in 0..2 {
            let refused = link.hello().unwrap_err();
            assert!(matches!(refused, DeviceError::SwitchedOff { .. }), "{refused}");
        }
        // The next program greets it.
        link.boot_id = None;
        let again = link.hello().unwrap();
        assert_eq!(again.boot_id, identity.boot_id, "the board itself has restarted");
        let sample = sample(&mut link, &clock);
        assert_eq!((sample.theta_counts, sample.alpha_counts), (0, 0));
    }
}

#[test]
fn no_hello_clears_an_emergency_stop_that_was_opened_since_the_first() {
    // The switch is pressed for 2 s with the motor off, and no sample shows it.
    let (mut link, clock) = link(Some(EmulatorFault::EmergencyStop { after_s: 0.5 }));
    link.hello().unwrap();
    sample(&mut link, &clock);
    clock.sleep_until(10_000 * MS);
    for _ in 0..2 {
        let refused = link.hello().unwrap_err();
        assert!(matches!(refused, DeviceError::StopOpened { .. }), "{refused}");
    }
}

/// A wire on which nothing arrives until a time.
struct SilentWire {
    wire: InProcessWire,
    clock: VirtualClock,
    silent_until_ns: Nanoseconds,
}

impl SilentWire {
    fn is_silent(&self) -> bool {
        self.clock.now_ns() < self.silent_until_ns
    }
}

impl Transport for SilentWire {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        if self.is_silent() {
            self.clock.sleep_until(deadline_ns.min(self.silent_until_ns));
            return Ok(0);
        }
        self.wire.read(buffer, deadline_ns)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        if self.is_silent() { Ok(()) } else { self.wire.write(bytes) }
    }

    fn name(&self) -> &str {
        "silent wire"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.wire.boot_time_ns()
    }
}

#[test]
fn no_hello_clears_an_emergency_stop_that_was_used_while_the_link_was_silent() {
    // The switch is pressed from 0.1 to 2.1 s.
    let fault = Some(EmulatorFault::EmergencyStop { after_s: 0.1 });
    let settings = EmulatorSettings { fault, seed: 7, ..EmulatorSettings::default() };
    let clock = VirtualClock::default();
    let wire = InProcessWire::new(settings, clock.clone());
    let wire = SilentWire { wire, clock: clock.clone(), silent_until_ns: 0 };
    let mut link = SerialLink::new(wire, Arc::new(clock.clone()));
    link.hello().unwrap();
    link.sample(clock.now_ns() + 10 * MS).unwrap();
    link.transport.silent_until_ns = 2200 * MS;
    let refused = link.hello().unwrap_err();
    assert!(matches!(refused, DeviceError::StopOpened { .. }), "{refused}");
    assert!(clock.now_ns() > 2200 * MS);
}

/// A wire whose device hears everything and whose answers are lost after this many requests.
struct MuteWire {
    wire: InProcessWire,
    clock: VirtualClock,
    answered: Option<u32>,
}

impl Transport for MuteWire {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let read = self.wire.read(buffer, deadline_ns)?;
        if self.answered != Some(0) {
            return Ok(read);
        }
        self.clock.sleep_until(deadline_ns);
        Ok(0)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        self.wire.write(bytes)?;
        // The answer to the last request that is answered is read before the next request.
        self.answered = self.answered.map(|answered| answered.saturating_sub(1));
        Ok(())
    }

    fn name(&self) -> &str {
        "mute wire"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.wire.boot_time_ns()
    }
}

#[test]
fn a_qube_that_was_off_is_not_forgotten_where_the_answers_to_a_hello_are_lost() {
    let fault = Some(EmulatorFault::SwitchedOffAndOn { after_s: 0.5, off_s: 1.0 });
    let settings = EmulatorSettings { fault, seed: 7, ..EmulatorSettings::default() };
    let clock = VirtualClock::default();
    let wire = InProcessWire::new(settings, clock.clone());
    let wire = MuteWire { wire, clock: clock.clone(), answered: None };
    let mut link = SerialLink::new(wire, Arc::new(clock.clone()));
    link.hello().unwrap();
    clock.sleep_until(2000 * MS);
    // The refusal of one sample arrives, and no answer to the hellos that follow.
    link.transport.answered = Some(2);
    let silent = link.hello().unwrap_err();
    assert!(matches!(silent, DeviceError::FellSilent { .. }), "{silent:?}");
    link.transport.answered = None;
    let refused = link.hello().unwrap_err();
    assert!(matches!(refused, DeviceError::SwitchedOff { .. }), "{refused:?}");
}

#[test]
fn a_qube_that_was_off_while_the_port_was_gone_counts_anew() {
    let fault = EmulatorFault::SwitchedOffAndOn { after_s: 0.5, off_s: 1.0 };
    let (mut link, clock) = link(Some(fault));
    let before = link.hello().unwrap();
    clock.sleep_until(600 * MS);
    link.reopen().unwrap();
    let absent = link.hello().unwrap_err();
    assert!(matches!(absent, DeviceError::QubeAbsent { .. }), "{absent}");
    clock.sleep_until(1600 * MS);
    let after = link.hello().unwrap();
    assert!(after.counts_anew && !before.is_same_start(&after), "{after:?}");
    assert!(after.is_same_start(&link.hello().unwrap()));
}
