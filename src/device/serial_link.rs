mod device_time;
mod greeting;

use std::sync::Arc;

use firmware_protocol::{
    Decoder, DeviceState, NO_ACT_US, RefusalReason, Reply, Request, SampleReply, StatusBits,
};

use self::device_time::DeviceTime;
use self::greeting::Seen;
use super::{
    AmplifierState, Device, DeviceError, Identity, LinkFault, MAX_SAMPLE_AGE_NS, Transport,
};
use crate::clock::{Clock, Nanoseconds};
use crate::qube::{Measurement, Status};

const MS: Nanoseconds = 1_000_000;

/// Time that an arm, a disarm and a sample before a hello wait for the answer, ns.
const ANSWER_TIME_NS: Nanoseconds = 100 * MS;

/// Number of attempts to arm or disarm: a healthy line may lose a frame.
const ATTEMPTS: u32 = 3;

/// Size of a read, bytes: several frames of the largest size.
const READ_BYTES: usize = 256;

/// The host's end of the wire: a [`Device`] over any [`Transport`].
///
/// The link accepts only replies with the sequence number of the current request and drops late
/// replies. The refusal of an act arrives during a later request and only updates the amplifier's
/// known state.
pub struct SerialLink<T: Transport> {
    transport: T,
    clock: Arc<dyn Clock>,
    decoder: Decoder,
    sequence: u16,
    /// Nonce for the next arm, or the reason why the device arms only after a hello.
    arm_nonce: Result<u32, RefusalReason>,
    /// True if an emulator answered the last hello; false if the hello failed.
    is_emulator: bool,
    /// Boot id that the caller's last hello returned.
    boot_id: Option<u16>,
    /// True if an arm or disarm has found that the device has restarted since that hello.
    has_restarted: bool,
    /// Operator actions seen since the first hello.
    seen: Seen,
    /// True if opening the port again was attempted since the last successful hello.
    was_reopened: bool,
    /// True if the device has refused a sample since the last successful hello because it was not
    /// greeted.
    was_ungreeted: bool,
    amplifier: AmplifierState,
    device_time: DeviceTime,
    /// Last sample since the last hello, the only one that an act may answer.
    last_sample: Option<LastSample>,
    /// True if a frame may be incomplete on the wire; the next request then begins with a delimiter
    /// that ends that frame.
    broken_frame: bool,
    traffic: Traffic,
    sample_time_ns: Option<Nanoseconds>,
}

/// The traffic since the last answer, from which an error message explains a silent or foreign
/// device.
#[derive(Clone, Copy, Debug, Default)]
struct Traffic {
    /// Time of the last valid answer, ns; `None` before the first.
    answered_ns: Option<Nanoseconds>,
    /// Bytes received since then, or since the first hello.
    bytes: u64,
    /// Valid requests among these bytes: a port sends them only as an echo.
    requests: u64,
}

/// A sample that was returned to the caller.
#[derive(Clone, Copy, Debug)]
struct LastSample {
    device_time_us: u64,
    asked_ns: Nanoseconds,
}

impl<T: Transport> SerialLink<T> {
    /// A link over an open wire. `clock` must be the clock of the transport's deadlines.
    #[must_use]
    pub fn new(transport: T, clock: Arc<dyn Clock>) -> Self {
        Self {
            transport,
            clock,
            decoder: Decoder::new(),
            sequence: 0,
            arm_nonce: Err(RefusalReason::NotGreeted),
            is_emulator: false,
            boot_id: None,
            has_restarted: false,
            seen: Seen::default(),
            was_reopened: false,
            was_ungreeted: false,
            amplifier: AmplifierState::Off,
            device_time: DeviceTime::default(),
            last_sample: None,
            broken_frame: false,
            traffic: Traffic::default(),
            sample_time_ns: None,
        }
    }

    /// The wire of the link.
    pub fn transport(&mut self) -> &mut T {
        &mut self.transport
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        let written = self.transport.write(bytes);
        self.broken_frame = written == Err(LinkFault::Full);
        written
    }

    /// Sends a request with a new sequence number and returns the number.
    fn send(&mut self, request: Request) -> Result<u16, LinkFault> {
        if self.broken_frame {
            self.write(&[0])?;
        }
        self.sequence = self.sequence.wrapping_add(1);
        self.write(request.encode(self.sequence).as_bytes())?;
        Ok(self.sequence)
    }

    /// Waits for the reply with this sequence number. Older replies are dropped, except that the
    /// refusal of an act updates the amplifier's known state.
    fn await_reply(&mut self, sequence: u16, deadline_ns: Nanoseconds) -> Result<Reply, LinkFault> {
        let mut buffer = [0; READ_BYTES];
        loop {
            let length = self.transport.read(&mut buffer, deadline_ns)?;
            if length == 0 {
                return Err(LinkFault::Timeout);
            }
            let mut awaited = None;
            for &byte in &buffer[..length] {
                self.traffic.bytes += 1;
                let Some(Ok(frame)) = self.decoder.push(byte) else { continue };
                let reply = Reply::parse(&frame);
                if reply.is_ok() {
                    let answered_ns = Some(self.clock.now_ns());
                    self.traffic = Traffic { answered_ns, ..Traffic::default() };
                }
                match reply {
                    Ok(reply) if frame.sequence == sequence => awaited = Some(reply),
                    Ok(Reply::Refusal { refused_type, reason }) => {
                        self.note_refusal(refused_type, reason);
                    }
                    Ok(_) => {}
                    Err(_) if Request::parse(&frame).is_ok() => self.traffic.requests += 1,
                    Err(_) => {}
                }
            }
            if let Some(reply) = awaited {
                return Ok(reply);
            }
            if self.clock.now_ns() >= deadline_ns {
                return Err(LinkFault::Timeout);
            }
        }
    }

    fn note_refusal(&mut self, refused_type: u8, reason: RefusalReason) {
        if refused_type != (Request::Act { voltage_mv: 0, sampled_at_us: 0 }).message_type() {
            return;
        }
        match reason {
            RefusalReason::WatchdogTripped => self.amplifier = AmplifierState::Tripped,
            RefusalReason::NotGreeted | RefusalReason::NotArmed | RefusalReason::Faulted => {
                self.amplifier = AmplifierState::Off;
            }
            _ => {}
        }
    }

    fn exchange(&mut self, request: Request, wait_ns: Nanoseconds) -> Result<Reply, LinkFault> {
        let sequence = self.send(request)?;
        let deadline_ns = self.clock.now_ns() + wait_ns;
        self.await_reply(sequence, deadline_ns)
    }

    /// The error for requests that have got no useful answer for `wait_ns`.
    fn silence(&self, nothing: &str, wait_ns: Nanoseconds) -> DeviceError {
        let Traffic { answered_ns, bytes, requests } = self.traffic;
        let nothing = format!("{nothing} in {:.1} s", wait_ns as f64 * 1e-9);
        if let Some(answered_ns) = answered_ns {
            let silent_s = (self.clock.now_ns() - answered_ns) as f64 * 1e-9;
            let since =
                if bytes > 0 { format!("{bytes} bytes that are not an answer") } else { nothing };
            return DeviceError::FellSilent { port: self.name(), silent_s, since };
        }
        self.not_a_qube(if requests > 0 {
            "it echoes the program's requests".into()
        } else if bytes > 0 {
            format!(
                "it sent {bytes} bytes that are not an answer (another device, or another baud rate)"
            )
        } else {
            nothing
        })
    }

    fn name(&self) -> String {
        self.transport.name().to_owned()
    }

    fn not_a_qube(&self, reason: String) -> DeviceError {
        DeviceError::NotAQube { port: self.name(), reason }
    }

    fn link_error(&self, fault: LinkFault) -> DeviceError {
        DeviceError::Link { port: self.name(), fault }
    }

    fn refused(&self, action: &'static str, reason: RefusalReason) -> DeviceError {
        DeviceError::Refused { port: self.name(), action, reason }
    }

    fn restarted(&self) -> DeviceError {
        DeviceError::Restarted { port: self.name() }
    }

    /// Takes the nonce for an arm: each is valid once.
    ///
    /// # Errors
    /// There is no nonce: the device has restarted or was not greeted, or a trip or fault is
    /// latched.
    fn take_nonce(&mut self) -> Result<u32, DeviceError> {
        match self.arm_nonce {
            Ok(nonce) => {
                self.arm_nonce = Err(RefusalReason::NotGreeted);
                Ok(nonce)
            }
            Err(_) if self.has_restarted => Err(self.restarted()),
            Err(RefusalReason::WatchdogTripped | RefusalReason::Faulted)
                if self.seen.stop_opened =>
            {
                Err(self.refused("arm", RefusalReason::EmergencyStop))
            }
            Err(reason) => Err(self.refused("arm", reason)),
        }
    }

    fn measurement(&mut self, sample: &SampleReply, asked_ns: Nanoseconds) -> Measurement {
        let status = Status {
            armed: sample.status.has(StatusBits::ARMED),
            watchdog_tripped: sample.status.has(StatusBits::WATCHDOG_TRIPPED),
            amplifier_fault: sample.status.has(StatusBits::AMPLIFIER_FAULT),
            stall_detected: sample.status.has(StatusBits::STALL_DETECTED),
            stall_error: sample.status.has(StatusBits::STALL_ERROR),
            emergency_stop: sample.status.has(StatusBits::EMERGENCY_STOP),
            stop_switch_fitted: sample.status.has(StatusBits::STOP_SWITCH_FITTED),
        };
        self.see_stop(status.emergency_stop);
        if self.amplifier == AmplifierState::Armed && !status.armed {
            self.amplifier =
                if status.watchdog_tripped { AmplifierState::Tripped } else { AmplifierState::Off };
        }
        let device_time_us = self.device_time.unwrap_us(sample.device_time_us);
        self.last_sample = Some(LastSample { device_time_us, asked_ns });
        Measurement {
            device_time_us,
            theta_counts: sample.theta_counts,
            alpha_counts: sample.alpha_counts,
            tachometer_counts_s: sample.tachometer_counts_s,
            current_a: f32::from(sample.current_ma) * 1e-3,
            status,
            applied_mv: sample.applied_mv,
            sample_to_act_us: (sample.sample_to_act_us != NO_ACT_US)
                .then_some(u32::from(sample.sample_to_act_us)),
        }
    }
}

impl<T: Transport> Device for SerialLink<T> {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        let (reply, counts_anew) = self.greet_unless_stopped()?;
        let identity = Identity { counts_anew, ..self.accept(&reply)? };
        (self.was_reopened, self.was_ungreeted) = (false, false);
        self.boot_id = Some(identity.boot_id);
        self.has_restarted = false;
        Ok(identity)
    }

    /// Arms the device; if the answer is lost or a frame arrives twice, sends a hello and arms
    /// again, three attempts in all.
    fn arm(&mut self) -> Result<(), DeviceError> {
        let mut nonce = self.take_nonce()?;
        for attempt in 1.. {
            match self.exchange(Request::Arm { nonce }, ANSWER_TIME_NS) {
                Ok(Reply::Arm { .. }) => break,
                Ok(Reply::Refusal { reason: RefusalReason::NotGreeted, .. }) => {
                    self.has_restarted = true;
                    return Err(self.restarted());
                }
                // A hello that arrives twice invalidates its first nonce; an arm that arrives twice
                // is refused the second time.
                Ok(Reply::Refusal { reason, .. })
                    if attempt == ATTEMPTS || !is_cured_by_greeting(reason) =>
                {
                    return Err(self.refused("arm", reason));
                }
                Ok(_) | Err(LinkFault::Timeout | LinkFault::Full) if attempt < ATTEMPTS => {
                    self.greet_same_start()?;
                    nonce = self.take_nonce()?;
                }
                Ok(_) => return Err(self.not_a_qube("it gave an arm a wrong reply".into())),
                Err(fault) => return Err(self.link_error(fault)),
            }
        }
        self.amplifier = AmplifierState::Armed;
        Ok(())
    }

    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
        let asked_ns = self.clock.now_ns();
        let sequence = self.send(Request::Sample)?;
        match self.await_reply(sequence, deadline_ns)? {
            Reply::Sample(sample) => Ok(self.measurement(&sample, asked_ns)),
            // The device has restarted and has had no hello since.
            Reply::Refusal { reason: RefusalReason::NotGreeted, .. } => {
                self.amplifier = AmplifierState::Off;
                Err(LinkFault::Restarted)
            }
            Reply::Refusal { reason: RefusalReason::QubeAbsent, .. } => {
                self.amplifier = AmplifierState::Off;
                self.seen.qube_off |= !self.was_reopened;
                Err(LinkFault::QubeOff)
            }
            _ => Err(LinkFault::Timeout),
        }
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        match self.amplifier {
            AmplifierState::Armed => {}
            AmplifierState::Tripped => return Err(LinkFault::WatchdogTripped),
            AmplifierState::Off => return Err(LinkFault::NotArmed),
        }
        let now_ns = self.clock.now_ns();
        let is_fresh = self.last_sample.is_some_and(|last| {
            last.device_time_us == sampled_at_us
                && now_ns.saturating_sub(last.asked_ns) <= MAX_SAMPLE_AGE_NS
        });
        if !is_fresh {
            return Err(LinkFault::StaleSample);
        }
        // The wire carries the lowest 32 bits of the time, as the device sent them.
        self.send(Request::Act { voltage_mv, sampled_at_us: sampled_at_us as u32 }).map(|_| ())
    }

    fn sample_time_ns(&self) -> Option<Nanoseconds> {
        self.sample_time_ns
    }

    fn set_sample_time_ns(&mut self, sample_time_ns: Nanoseconds) {
        self.sample_time_ns = Some(sample_time_ns);
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        let was_armed = self.amplifier == AmplifierState::Armed;
        self.amplifier = AmplifierState::Off;
        for attempt in 1.. {
            match self.exchange(Request::Disarm, ANSWER_TIME_NS) {
                // A device has switched its motor off only if its reply reports so.
                Ok(Reply::Disarm(reply)) if reply.state == DeviceState::Armed => {
                    if attempt == ATTEMPTS {
                        let port = self.name();
                        return Err(DeviceError::StaysArmed { port });
                    }
                }
                Ok(Reply::Disarm(reply)) => {
                    self.arm_nonce = match reply.state {
                        _ if reply.nonce != 0 => Ok(reply.nonce),
                        DeviceState::Tripped => Err(RefusalReason::WatchdogTripped),
                        DeviceState::Faulted => Err(RefusalReason::Faulted),
                        DeviceState::Idle | DeviceState::Greeted | DeviceState::Armed => {
                            Err(RefusalReason::NotGreeted)
                        }
                    };
                    // The watchdog tripped while this call waited for the answer to a lost disarm.
                    // That is no fault, so a hello clears it; a trip before this call is a fault
                    // and stays latched.
                    if was_armed && attempt > 1 && reply.state == DeviceState::Tripped {
                        self.greet_same_start()?;
                    }
                    break;
                }
                Ok(Reply::Refusal { reason, .. }) if attempt == ATTEMPTS => {
                    return Err(self.refused("disarm", reason));
                }
                Ok(_) | Err(LinkFault::Timeout | LinkFault::Full) if attempt < ATTEMPTS => {}
                Ok(_) => return Err(self.not_a_qube("it gave a disarm a wrong reply".into())),
                Err(fault) => return Err(self.link_error(fault)),
            }
        }
        Ok(())
    }

    fn reopen(&mut self) -> Result<(), DeviceError> {
        self.was_reopened = true;
        self.amplifier = AmplifierState::Off;
        self.arm_nonce = Err(RefusalReason::NotGreeted);
        self.last_sample = None;
        self.decoder.reset();
        self.transport.reopen()
    }

    fn is_hardware(&self) -> bool {
        !self.is_emulator
    }
}

impl<T: Transport> Drop for SerialLink<T> {
    /// Disarms at once when an armed link is dropped, for instance by a panic, rather than leave it
    /// to the watchdog.
    fn drop(&mut self) {
        if self.amplifier == AmplifierState::Armed {
            let _ = self.send(Request::Disarm);
        }
    }
}

/// Returns whether a new hello may remedy this refusal of an arm.
fn is_cured_by_greeting(reason: RefusalReason) -> bool {
    matches!(reason, RefusalReason::WrongNonce | RefusalReason::AlreadyArmed)
}

#[cfg(test)]
mod tests;
