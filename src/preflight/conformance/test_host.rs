use std::collections::VecDeque;

use firmware_protocol::{
    Decoder, Frame, HelloReply, PROTOCOL_VERSION, RefusalReason, Reply, Request, SampleReply,
    StatusBits,
};

use super::{Deviation, ensure};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{LinkFault, Transport};

/// Time without an answer after which the device counts as silent, ns: 1 s.
const PATIENCE_NS: Nanoseconds = 1_000_000_000;

/// A host for the checks: it sends exactly the requests and bytes of a check, and accepts only the
/// expected answer.
pub struct TestHost<'a> {
    transport: &'a mut dyn Transport,
    clock: &'a dyn Clock,
    decoder: Decoder,
    received: VecDeque<Frame>,
    sequence: u16,
    /// Time of the last sample by the device's clock, us; acts refer to it.
    sampled_at_us: u32,
    /// Time of the request of the last sample, by the computer's clock, ns.
    sampled_ns: Nanoseconds,
    /// Time of the last act, by the computer's clock, ns.
    acted_ns: Nanoseconds,
}

/// Time from the request of a sample to an act, by the computer's clock, ns, up to which the act
/// reaches the device in time on any line: within 20 ms of the sample.
const SURELY_FRESH_NS: Nanoseconds = 8_000_000;

impl<'a> TestHost<'a> {
    /// A host that uses this wire and measures its deadlines by this clock.
    pub fn new(transport: &'a mut dyn Transport, clock: &'a dyn Clock) -> Self {
        let received = VecDeque::new();
        Self {
            transport,
            clock,
            decoder: Decoder::new(),
            received,
            sequence: 0,
            sampled_at_us: 0,
            sampled_ns: 0,
            acted_ns: 0,
        }
    }

    /// The time by the computer's clock, ns.
    pub(super) fn now_ns(&self) -> Nanoseconds {
        self.clock.now_ns()
    }

    /// Waits for this duration, ns, by the computer's clock.
    pub(super) fn wait_ns(&mut self, duration_ns: Nanoseconds) {
        self.clock.sleep_until(self.clock.now_ns() + duration_ns);
    }

    /// Brings the device from any state into the state Greeted, and drops replies to earlier
    /// requests. Waits for a device that is still booting.
    pub(super) fn resynchronise(&mut self) -> Result<(), Deviation> {
        let end_ns = self.clock.now_ns() + self.transport.boot_time_ns();
        loop {
            self.send_bytes(&[0])?;
            let sequence = self.send(Request::Hello { protocol_version: PROTOCOL_VERSION })?;
            let deadline_ns = self.clock.now_ns() + PATIENCE_NS;
            while let Some(frame) = self.next_frame(deadline_ns)? {
                if frame.sequence == sequence && matches!(Reply::parse(&frame), Ok(Reply::Hello(_)))
                {
                    return Ok(());
                }
                // A device that sends other frames without end counts as silent.
                if self.clock.now_ns() >= deadline_ns {
                    break;
                }
            }
            if self.clock.now_ns() >= end_ns {
                return Err(Deviation::Silent("Hello"));
            }
        }
    }

    /// Sends raw bytes.
    pub(super) fn send_bytes(&mut self, bytes: &[u8]) -> Result<(), Deviation> {
        Ok(self.transport.write(bytes)?)
    }

    /// Takes and returns the next sequence number.
    pub(super) fn next_sequence(&mut self) -> u16 {
        self.sequence = self.sequence.wrapping_add(1);
        self.sequence
    }

    /// Sets the sequence number that the next request follows.
    pub(super) fn set_sequence(&mut self, sequence: u16) {
        self.sequence = sequence;
    }

    /// An act that refers to the last sample.
    pub(super) fn act_request(&self, voltage_mv: i16) -> Request {
        Request::Act { voltage_mv, sampled_at_us: self.sampled_at_us }
    }

    /// Sends an act that refers to the last sample, and returns its sequence number. The device
    /// accepts the act only while the sample is fresh.
    pub(super) fn act(&mut self, voltage_mv: i16) -> Result<u16, Deviation> {
        self.acted_ns = self.clock.now_ns();
        self.send(self.act_request(voltage_mv))
    }

    /// Sends a request without waiting for the answer, and returns its sequence number.
    pub(super) fn send(&mut self, request: Request) -> Result<u16, Deviation> {
        let sequence = self.next_sequence();
        self.send_bytes(request.encode(sequence).as_bytes())?;
        Ok(sequence)
    }

    /// Returns the next frame; `None` if none is complete by the deadline. If the computer is late,
    /// the function reads the bytes that have arrived by then once. Bytes that form no frame do not
    /// delay the end.
    fn next_frame(&mut self, deadline_ns: Nanoseconds) -> Result<Option<Frame>, LinkFault> {
        let mut buffer = [0; 256];
        let mut is_over = false;
        while self.received.is_empty() && !is_over {
            is_over = self.clock.now_ns() >= deadline_ns;
            let length = self.transport.read(&mut buffer, deadline_ns)?;
            if length == 0 {
                return Ok(None);
            }
            for &byte in &buffer[..length] {
                if let Some(Ok(frame)) = self.decoder.push(byte) {
                    self.received.push_back(frame);
                }
            }
        }
        Ok(self.received.pop_front())
    }

    /// Returns the next frame as the reply to `request`; it must have this sequence number.
    pub(super) fn reply_to(
        &mut self,
        sequence: u16,
        request: &'static str,
    ) -> Result<Reply, Deviation> {
        let frame = self
            .next_frame(self.clock.now_ns() + PATIENCE_NS)?
            .ok_or(Deviation::Silent(request))?;
        let reply = Reply::parse(&frame).map_err(|error| {
            Deviation::Wrong(format!("{request} was answered wrongly: {error}"))
        })?;
        // Acts are sent without waiting for an answer, so the refusal of an act arrives while the
        // answer to a later request is expected.
        if let Reply::Refusal { refused_type, reason } = reply
            && frame.sequence != sequence
            && refused_type == self.act_request(0).message_type()
        {
            let elapsed_ns = self.acted_ns.saturating_sub(self.sampled_ns);
            match reason {
                RefusalReason::WatchdogTripped => return Err(Deviation::Disturbed),
                // By the device's clock, the act came more than 20 ms after its sample. The
                // computer was slow too, so the device may be right.
                RefusalReason::StaleSample if elapsed_ns > SURELY_FRESH_NS => {
                    return Err(Deviation::Disturbed);
                }
                RefusalReason::StaleSample => {
                    return Err(Deviation::FreshRefused { elapsed_us: elapsed_ns / 1000 });
                }
                _ => {}
            }
        }
        ensure!(
            frame.sequence == sequence,
            "the answer to {request} {sequence} should come next, but {reply:?} to {} came",
            frame.sequence
        );
        Ok(reply)
    }

    /// Sends a request and returns its answer.
    pub(super) fn ask(&mut self, request: Request) -> Result<Reply, Deviation> {
        let sequence = self.send(request)?;
        self.reply_to(sequence, request_name(request))
    }

    /// Sends a hello of the host's protocol version, and returns the reply.
    pub(super) fn greet(&mut self) -> Result<HelloReply, Deviation> {
        self.greet_as(PROTOCOL_VERSION)
    }

    /// Sends a hello of this protocol version, and returns the reply.
    pub(super) fn greet_as(&mut self, protocol_version: u16) -> Result<HelloReply, Deviation> {
        match self.ask(Request::Hello { protocol_version })? {
            Reply::Hello(reply) => Ok(reply),
            other => Err(unexpected("Hello", &other)),
        }
    }

    /// Greets and arms; returns the time of arming by the device's clock, us, and the nonce.
    pub(super) fn arm(&mut self) -> Result<(u32, u32), Deviation> {
        let nonce = self.greet()?.nonce;
        Ok((self.arm_with(nonce)?, nonce))
    }

    /// Arms with this nonce; returns the time of arming by the device's clock, us.
    pub(super) fn arm_with(&mut self, nonce: u32) -> Result<u32, Deviation> {
        match self.ask(Request::Arm { nonce })? {
            Reply::Arm { device_time_us } => Ok(device_time_us),
            other => Err(unexpected("Arm", &other)),
        }
    }

    /// Requests a sample, which every state but Idle answers.
    pub(super) fn sample(&mut self) -> Result<SampleReply, Deviation> {
        let asked_ns = self.clock.now_ns();
        match self.ask(Request::Sample)? {
            Reply::Sample(reply) => {
                (self.sampled_at_us, self.sampled_ns) = (reply.device_time_us, asked_ns);
                Ok(reply)
            }
            other => Err(unexpected("Sample", &other)),
        }
    }

    /// Requests a sample, which must show the device armed. A tripped watchdog means that the
    /// computer was too slow.
    pub(super) fn sample_armed(&mut self) -> Result<SampleReply, Deviation> {
        let sample = self.sample()?;
        if sample.status.has(StatusBits::WATCHDOG_TRIPPED) {
            return Err(Deviation::Disturbed);
        }
        ensure!(sample.status.has(StatusBits::ARMED), "the device should be armed: {sample:?}");
        Ok(sample)
    }

    /// Sends a request that must be refused for this reason.
    pub(super) fn refused(
        &mut self,
        request: Request,
        expected: RefusalReason,
    ) -> Result<(), Deviation> {
        let sequence = self.send(request)?;
        self.refusal_of(sequence, request.message_type(), request_name(request), expected)
    }

    /// Expects the refusal of a request as the next frame.
    pub(super) fn refusal_of(
        &mut self,
        sequence: u16,
        message_type: u8,
        name: &'static str,
        expected: RefusalReason,
    ) -> Result<(), Deviation> {
        match self.reply_to(sequence, name)? {
            Reply::Refusal { refused_type, reason }
                if refused_type == message_type && reason == expected =>
            {
                Ok(())
            }
            Reply::Refusal { reason: RefusalReason::WatchdogTripped, .. } => {
                Err(Deviation::Disturbed)
            }
            other => Err(Deviation::Wrong(format!(
                "{name} should be refused with {expected:?}, but the answer was {other:?}"
            ))),
        }
    }
}

fn unexpected(request: &'static str, reply: &Reply) -> Deviation {
    match reply {
        Reply::Refusal { reason: RefusalReason::WatchdogTripped, .. } => Deviation::Disturbed,
        other => Deviation::Wrong(format!("{request} was answered with {other:?}")),
    }
}

fn request_name(request: Request) -> &'static str {
    match request {
        Request::Hello { .. } => "Hello",
        Request::Arm { .. } => "Arm",
        Request::Sample => "Sample",
        Request::Act { .. } => "Act",
        Request::Disarm => "Disarm",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::VirtualClock;

    /// A device that sends the same bytes without end.
    struct Chatter {
        clock: VirtualClock,
        bytes: Vec<u8>,
    }

    impl Transport for Chatter {
        fn read(&mut self, buffer: &mut [u8], _: Nanoseconds) -> Result<usize, LinkFault> {
            self.clock.advance(1_000_000);
            buffer[..self.bytes.len()].copy_from_slice(&self.bytes);
            Ok(self.bytes.len())
        }

        fn write(&mut self, _: &[u8]) -> Result<(), LinkFault> {
            Ok(())
        }

        fn name(&self) -> &str {
            "chatter"
        }

        fn boot_time_ns(&self) -> Nanoseconds {
            3_000_000_000
        }
    }

    #[test]
    fn a_device_that_sends_other_bytes_without_end_is_silent() {
        let frame = Request::Sample.encode(7).as_bytes().to_vec();
        for bytes in [vec![0x55; 40], frame] {
            let clock = VirtualClock::default();
            let mut wire = Chatter { clock: clock.clone(), bytes };
            let mut host = TestHost::new(&mut wire, &clock);
            assert_eq!(host.resynchronise(), Err(Deviation::Silent("Hello")));
            assert!(clock.now_ns() < 5_000_000_000, "it took {} ns", clock.now_ns());
        }
    }
}
