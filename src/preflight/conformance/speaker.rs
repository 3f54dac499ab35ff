use std::collections::VecDeque;

use firmware_protocol::{
    Decoder, Frame, HelloReply, PROTOCOL_VERSION, RefusalReason, Reply, Request, SampleReply,
    StatusBits,
};

use super::{Deviation, ensure};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{LinkFault, Transport};

/// How long a request may stay unanswered before the device counts as silent.
const PATIENCE_NS: Nanoseconds = 1_000_000_000;

/// A host that says exactly what it is told, and takes nothing but the expected answer.
pub struct Speaker<'a> {
    transport: &'a mut dyn Transport,
    clock: &'a dyn Clock,
    decoder: Decoder,
    received: VecDeque<Frame>,
    sequence: u16,
    /// Time of the last sample, which acts answer.
    sampled_at_us: u32,
    /// When that sample was asked for and when an act answered it last, by the computer's clock.
    sampled_ns: Nanoseconds,
    acted_ns: Nanoseconds,
}

/// An act that is sent so soon after its sample was asked for is fresh, whatever the line.
const SURELY_FRESH_NS: Nanoseconds = 8_000_000;

impl<'a> Speaker<'a> {
    /// Speaks over this wire; the clock is the one that the transport's deadlines mean.
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

    /// The computer's time, for comparing clocks.
    pub(super) fn now_ns(&self) -> Nanoseconds {
        self.clock.now_ns()
    }

    /// Lets time pass.
    pub(super) fn wait_ns(&mut self, duration_ns: Nanoseconds) {
        self.clock.sleep_until(self.clock.now_ns() + duration_ns);
    }

    /// Puts the device into Greeted, whatever it was doing, and forgets what came before that. A
    /// device that is still booting is waited for.
    pub(super) fn fence(&mut self) -> Result<(), Deviation> {
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
            }
            if self.clock.now_ns() >= end_ns {
                return Err(Deviation::Silent("Hello"));
            }
        }
    }

    /// Sends bytes as they are.
    pub(super) fn send_bytes(&mut self, bytes: &[u8]) -> Result<(), Deviation> {
        Ok(self.transport.write(bytes)?)
    }

    /// A sequence number of its own.
    pub(super) fn next_sequence(&mut self) -> u16 {
        self.sequence = self.sequence.wrapping_add(1);
        self.sequence
    }

    /// Goes on counting from here.
    pub(super) fn set_sequence(&mut self, sequence: u16) {
        self.sequence = sequence;
    }

    /// An act that answers the last sample.
    pub(super) fn act_request(&self, voltage_mv: i16) -> Request {
        Request::Act { voltage_mv, sampled_at_us: self.sampled_at_us }
    }

    /// Sends an act that answers the last sample, which must be fresh to be accepted.
    pub(super) fn act(&mut self, voltage_mv: i16) -> Result<u16, Deviation> {
        self.acted_ns = self.clock.now_ns();
        self.send(self.act_request(voltage_mv))
    }

    /// Sends a request without waiting for an answer.
    pub(super) fn send(&mut self, request: Request) -> Result<u16, Deviation> {
        let sequence = self.next_sequence();
        self.send_bytes(request.encode(sequence).as_bytes())?;
        Ok(sequence)
    }

    fn next_frame(&mut self, deadline_ns: Nanoseconds) -> Result<Option<Frame>, LinkFault> {
        let mut buffer = [0; 256];
        while self.received.is_empty() {
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

    /// The next frame that comes, which must answer the request with this sequence number.
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
        // Acts are sent without waiting for their answer, so what refuses one comes here.
        if let Reply::Refusal { refused_type, reason } = reply
            && frame.sequence != sequence
            && refused_type == self.act_request(0).message_type()
        {
            let elapsed_ns = self.acted_ns.saturating_sub(self.sampled_ns);
            match reason {
                RefusalReason::WatchdogTripped => return Err(Deviation::Disturbed),
                // It came more than 20 ms after its sample, or so the device says.
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

    /// Greets by this version.
    pub(super) fn greet(&mut self) -> Result<HelloReply, Deviation> {
        self.greet_as(PROTOCOL_VERSION)
    }

    /// Greets by some version.
    pub(super) fn greet_as(&mut self, protocol_version: u16) -> Result<HelloReply, Deviation> {
        match self.ask(Request::Hello { protocol_version })? {
            Reply::Hello(reply) => Ok(reply),
            other => Err(unexpected("Hello", &other)),
        }
    }

    /// Greets and arms; the device's time of arming, and the nonce that was used.
    pub(super) fn arm(&mut self) -> Result<(u32, u32), Deviation> {
        let nonce = self.greet()?.nonce;
        Ok((self.arm_with(nonce)?, nonce))
    }

    /// Arms; the device's time of arming.
    pub(super) fn arm_with(&mut self, nonce: u32) -> Result<u32, Deviation> {
        match self.ask(Request::Arm { nonce })? {
            Reply::Arm { device_time_us } => Ok(device_time_us),
            other => Err(unexpected("Arm", &other)),
        }
    }

    /// A sample in any state but Idle.
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

    /// A sample that should show the device armed. Tripped means that the computer was too slow.
    pub(super) fn sample_armed(&mut self) -> Result<SampleReply, Deviation> {
        let sample = self.sample()?;
        if sample.status.has(StatusBits::WATCHDOG_TRIPPED) {
            return Err(Deviation::Disturbed);
        }
        ensure!(sample.status.has(StatusBits::ARMED), "the device should be armed: {sample:?}");
        Ok(sample)
    }

    /// A request that must be refused for this reason.
    pub(super) fn refused(
        &mut self,
        request: Request,
        expected: RefusalReason,
    ) -> Result<(), Deviation> {
        let sequence = self.send(request)?;
        self.refusal_of(sequence, request.message_type(), request_name(request), expected)
    }

    /// The refusal that must come next.
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
