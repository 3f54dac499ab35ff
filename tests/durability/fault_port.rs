//! A wire that fails at a chosen operation: a proxy between the host's link and the emulated board.

use std::collections::VecDeque;

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::device::{LinkFault, Transport};

const MS: Nanoseconds = 1_000_000;

/// A failure of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The operation's bytes are lost.
    Drop,
    /// The operation's bytes are delayed by this time, ns, and later bytes do not overtake them.
    Delay(Nanoseconds),
    /// A bit of the operation's bytes is flipped.
    Garble,
    /// The operation's bytes come twice.
    Duplicate,
    /// The operation's bytes come after the bytes of the next operation in the same direction.
    Reorder,
    /// The second half of the operation's bytes is lost.
    Truncate,
    /// A read returns one byte now and the rest later; a write takes half of its bytes and fails
    /// because the port is full.
    Short,
    /// The operating system reports an error.
    InputOutputError,
    /// A read finds the end of the file and reports that the port is gone; a write goes nowhere.
    EndOfFile,
    /// A read gets nothing until its deadline; a write fails because the port is full.
    Hang,
    /// The port is gone; the device is back under another name.
    Rename,
}

/// All failures, with two delays that a healthy link may have and one delay that is longer than the
/// time of the device's watchdog.
pub const KINDS: [Kind; 13] = [
    Kind::Drop,
    Kind::Delay(13 * MS),
    Kind::Delay(20 * MS),
    Kind::Delay(200 * MS),
    Kind::Garble,
    Kind::Duplicate,
    Kind::Reorder,
    Kind::Truncate,
    Kind::Short,
    Kind::InputOutputError,
    Kind::EndOfFile,
    Kind::Hang,
    Kind::Rename,
];

impl Kind {
    /// Returns whether a healthy link has this failure from time to time: a single failure of this
    /// kind must not end a motion.
    pub fn is_ordinary(self) -> bool {
        match self {
            Self::Drop
            | Self::Garble
            | Self::Duplicate
            | Self::Reorder
            | Self::Truncate
            | Self::Short
            | Self::Hang => true,
            Self::Delay(delay_ns) => delay_ns <= 20 * MS,
            Self::InputOutputError | Self::EndOfFile | Self::Rename => false,
        }
    }
}

/// The failing operation and its failure. Reads and writes are counted together, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    pub operation: u64,
    pub kind: Kind,
    /// True if all later operations fail too, in the same way.
    pub lasting: bool,
}

/// Bytes in transit in one direction, each piece with its time of arrival.
#[derive(Debug, Default)]
struct Held {
    pieces: VecDeque<(Nanoseconds, Vec<u8>)>,
    /// Piece that arrives after the next one.
    overtaken: Option<Vec<u8>>,
}

impl Held {
    /// Adds a piece; pieces keep their order in spite of different delays.
    fn push(&mut self, arrival_ns: Nanoseconds, bytes: Vec<u8>) {
        let earliest_ns = self.pieces.back().map_or(0, |(arrival_ns, _)| *arrival_ns);
        self.pieces.push_back((arrival_ns.max(earliest_ns), bytes));
        if let Some(overtaken) = self.overtaken.take() {
            self.push(arrival_ns, overtaken);
        }
    }

    fn pop_due(&mut self, now_ns: Nanoseconds) -> Option<Vec<u8>> {
        self.pieces.pop_front_if(|(arrival_ns, _)| *arrival_ns <= now_ns).map(|(_, bytes)| bytes)
    }

    fn next_ns(&self) -> Option<Nanoseconds> {
        self.pieces.front().map(|(arrival_ns, _)| *arrival_ns)
    }
}

/// The proxy. Without a fault a read delivers a whole frame, as a USB adapter does: each operation
/// that moves bytes is then a message.
pub struct FaultPort<T> {
    wire: T,
    clock: VirtualClock,
    plan: Option<Plan>,
    operations: u64,
    gone: bool,
    to_device: Held,
    to_host: Held,
    /// Bytes that have arrived and wait for the host.
    arrived: VecDeque<u8>,
}

impl<T: Transport> FaultPort<T> {
    pub fn new(wire: T, clock: VirtualClock, plan: Option<Plan>) -> Self {
        Self {
            wire,
            clock,
            plan,
            operations: 0,
            gone: false,
            to_device: Held::default(),
            to_host: Held::default(),
            arrived: VecDeque::new(),
        }
    }

    /// Number of operations so far.
    pub fn operations(&self) -> u64 {
        self.operations
    }

    /// Counts an operation; returns its failure, if any.
    fn next_fault(&mut self) -> Option<Kind> {
        let operation = self.operations;
        self.operations += 1;
        let plan = self.plan?;
        let strikes = operation == plan.operation || (plan.lasting && operation > plan.operation);
        strikes.then_some(plan.kind)
    }

    fn hand_over_due(&mut self) -> Result<(), LinkFault> {
        while let Some(bytes) = self.to_device.pop_due(self.clock.now_ns()) {
            self.wire.write(&bytes)?;
        }
        while let Some(bytes) = self.to_host.pop_due(self.clock.now_ns()) {
            self.arrived.extend(bytes);
        }
        Ok(())
    }

    /// Waits for one frame from the device; held pieces are delivered meanwhile, each at its time.
    fn frame_from_device(&mut self, deadline_ns: Nanoseconds) -> Result<Vec<u8>, LinkFault> {
        let mut frame = Vec::new();
        let mut buffer = [0; 1];
        loop {
            self.hand_over_due()?;
            if !self.arrived.is_empty() {
                return Ok(frame);
            }
            let held_ns = [self.to_device.next_ns(), self.to_host.next_ns()];
            let wake_ns = held_ns.into_iter().flatten().fold(deadline_ns, Nanoseconds::min);
            if self.wire.read(&mut buffer, wake_ns)? == 1 {
                frame.push(buffer[0]);
                if buffer[0] == 0 {
                    return Ok(frame);
                }
            } else if self.clock.now_ns() >= deadline_ns {
                return Ok(frame);
            }
        }
    }

    fn take(&mut self, buffer: &mut [u8], most: usize) -> usize {
        let length = buffer.len().min(most).min(self.arrived.len());
        for (place, byte) in buffer.iter_mut().zip(self.arrived.drain(..length)) {
            *place = byte;
        }
        length
    }

    fn garbled(&self, mut bytes: Vec<u8>) -> Vec<u8> {
        let place = self.operations as usize % bytes.len().max(1);
        if let Some(byte) = bytes.get_mut(place) {
            *byte ^= 1 << (self.operations % 8);
        }
        bytes
    }
}

impl<T: Transport> Transport for FaultPort<T> {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let fault = self.next_fault();
        self.gone |= fault == Some(Kind::Rename);
        if self.gone || matches!(fault, Some(Kind::InputOutputError | Kind::EndOfFile)) {
            return Err(LinkFault::Gone);
        }
        let deadline_ns = deadline_ns.max(self.clock.now_ns());
        if fault == Some(Kind::Hang) {
            self.clock.sleep_until(deadline_ns);
            return Ok(0);
        }
        let mut fault = fault;
        loop {
            let frame = self.frame_from_device(deadline_ns)?;
            let now_ns = self.clock.now_ns();
            if !frame.is_empty() {
                // A single fault affects the first frame of the read only.
                let lasting = self.plan.is_some_and(|plan| plan.lasting);
                let strikes = if lasting { fault } else { fault.take() };
                match strikes {
                    Some(Kind::Drop) => {}
                    Some(Kind::Delay(delay_ns)) => self.to_host.push(now_ns + delay_ns, frame),
                    Some(Kind::Garble) => {
                        let garbled = self.garbled(frame);
                        self.to_host.push(now_ns, garbled);
                    }
                    Some(Kind::Duplicate) => {
                        self.to_host.push(now_ns, [frame.as_slice(), &frame].concat());
                    }
                    Some(Kind::Reorder) if self.to_host.overtaken.is_none() => {
                        self.to_host.overtaken = Some(frame);
                    }
                    Some(Kind::Truncate) => {
                        self.to_host.push(now_ns, frame[..frame.len() / 2].to_vec());
                    }
                    Some(Kind::Short) => {
                        self.arrived.extend(frame);
                        return Ok(self.take(buffer, 1));
                    }
                    _ => self.to_host.push(now_ns, frame),
                }
                self.hand_over_due()?;
            }
            if !self.arrived.is_empty() || self.clock.now_ns() >= deadline_ns {
                return Ok(self.take(buffer, usize::MAX));
            }
        }
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        let fault = self.next_fault();
        self.gone |= fault == Some(Kind::Rename);
        if self.gone || fault == Some(Kind::InputOutputError) {
            return Err(LinkFault::Gone);
        }
        self.hand_over_due()?;
        let now_ns = self.clock.now_ns();
        match fault {
            Some(Kind::Drop | Kind::EndOfFile) => {}
            Some(Kind::Hang) => return Err(LinkFault::Full),
            Some(Kind::Delay(delay_ns)) => self.to_device.push(now_ns + delay_ns, bytes.to_vec()),
            Some(Kind::Garble) => {
                let garbled = self.garbled(bytes.to_vec());
                self.to_device.push(now_ns, garbled);
            }
            Some(Kind::Duplicate) => self.to_device.push(now_ns, [bytes, bytes].concat()),
            Some(Kind::Reorder) if self.to_device.overtaken.is_none() => {
                self.to_device.overtaken = Some(bytes.to_vec());
            }
            Some(Kind::Truncate) => {
                self.to_device.push(now_ns, bytes[..bytes.len() / 2].to_vec());
            }
            Some(Kind::Short) => {
                self.to_device.push(now_ns, bytes[..bytes.len() / 2].to_vec());
                self.hand_over_due()?;
                return Err(LinkFault::Full);
            }
            _ => self.to_device.push(now_ns, bytes.to_vec()),
        }
        self.hand_over_due()
    }

    fn name(&self) -> &str {
        "fault port"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        self.wire.boot_time_ns()
    }
}
