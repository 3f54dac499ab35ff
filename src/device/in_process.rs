use std::collections::VecDeque;
use std::sync::Arc;

use firmware_protocol::{BAUD_RATE, BITS_PER_BYTE};

use super::emulator::{Board, EmulatorSettings, UsbBridge};
use super::{LinkFault, SerialLink, Transport};
use crate::clock::{Clock, Nanoseconds, VirtualClock};

/// Name of the port of an emulated Qube in virtual time.
pub const IN_PROCESS: &str = "in-process";

/// Time of one byte on the line, ns: 20 us.
const BYTE_NS: Nanoseconds = 1_000_000_000 * BITS_PER_BYTE as u64 / BAUD_RATE as u64;

/// Time from the arrival of a request's last byte until the board begins its reply, ns: an 8-bit
/// microcontroller at 16 MHz checks one frame and builds another.
const TURNAROUND_NS: Nanoseconds = 100_000;

/// Time that a hello may stay unanswered, ns: PROTOCOL.md allows this time to a board that
/// restarts.
const BOOT_TIME_NS: Nanoseconds = 2_500_000_000;

/// An emulated board on a line in memory, in virtual time.
///
/// Each byte takes its time at the line's rate in either direction, and a reply starts a fixed
/// turnaround after its request. A USB bridge, if the settings name one, delays the bytes further.
/// Writing takes no time, as with a port's buffer; reading moves the clock to the arrival of the
/// next byte, but no further than the deadline.
#[derive(Debug)]
pub struct InProcessWire {
    board: Board,
    bridge: Option<UsbBridge>,
    clock: VirtualClock,
    to_board: Line,
    to_host: Line,
}

/// Size of a port's buffer, bytes; bytes that arrive at a full buffer are lost, as in a real port.
const BUFFER_BYTES: usize = 4096;

/// Bytes in transit, each with its time of arrival.
#[derive(Debug)]
struct Line {
    /// Time at which the last byte has left the line, ns; the next byte starts then at the
    /// earliest.
    free_ns: Nanoseconds,
    under_way: VecDeque<(Nanoseconds, u8)>,
}

impl Line {
    fn new() -> Self {
        Self { free_ns: 0, under_way: VecDeque::with_capacity(BUFFER_BYTES) }
    }

    fn send(&mut self, bytes: &[u8], from_ns: Nanoseconds) {
        self.free_ns = self.free_ns.max(from_ns);
        for &byte in bytes {
            self.free_ns += BYTE_NS;
            if self.under_way.len() < BUFFER_BYTES {
                self.under_way.push_back((self.free_ns, byte));
            }
        }
    }

    fn receive_by(&mut self, time_ns: Nanoseconds) -> Option<(Nanoseconds, u8)> {
        self.under_way.pop_front_if(|(arrival_ns, _)| *arrival_ns <= time_ns)
    }
}

impl InProcessWire {
    /// A wire to a board that started when the clock showed 0.
    #[must_use]
    pub fn new(settings: EmulatorSettings, clock: VirtualClock) -> Self {
        Self {
            bridge: settings.bridge,
            board: Board::new(settings),
            clock,
            to_board: Line::new(),
            to_host: Line::new(),
        }
    }

    /// The board, advanced to the current time, for tests that inspect state that the wire does not
    /// show.
    pub fn board(&mut self) -> &mut Board {
        self.run_board_until(self.clock.now_ns());
        &mut self.board
    }

    /// Runs the board up to a time, ns: it receives the bytes that arrive until then and sends its
    /// replies.
    fn run_board_until(&mut self, time_ns: Nanoseconds) {
        while let Some((arrival_ns, byte)) = self.to_board.receive_by(time_ns) {
            self.board.advance_to(arrival_ns / 1000);
            let Some(reply) = self.board.receive(byte) else { continue };
            let earlier = self.to_host.under_way.len();
            self.to_host.send(reply.as_bytes(), arrival_ns + TURNAROUND_NS);
            if let Some(bridge) = self.bridge {
                for (arrival_ns, _) in self.to_host.under_way.iter_mut().skip(earlier) {
                    *arrival_ns = bridge.reaches_host_ns(*arrival_ns);
                }
            }
            if self.board.garbles_reply()
                && let Some((_, last)) = self.to_host.under_way.iter_mut().nth_back(1)
            {
                *last ^= 0x10;
            }
        }
        self.board.advance_to(time_ns / 1000);
    }
}

impl Transport for InProcessWire {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let deadline_ns = deadline_ns.max(self.clock.now_ns());
        let wake_ns = loop {
            if let Some((arrival_ns, _)) = self.to_host.under_way.front() {
                break (*arrival_ns).min(deadline_ns);
            }
            // The board gets one byte at a time, so that its clock does not run ahead of the
            // arrival of its first reply.
            match self.to_board.under_way.front() {
                Some((arrival_ns, _)) if *arrival_ns <= deadline_ns => {
                    self.run_board_until(*arrival_ns);
                }
                _ => break deadline_ns,
            }
        };
        self.clock.sleep_until(wake_ns);
        let now_ns = self.clock.now_ns();
        self.run_board_until(now_ns);
        if self.board.is_unplugged() {
            return Err(LinkFault::Gone);
        }
        let mut length = 0;
        while let Some(place) = buffer.get_mut(length)
            && let Some((_, byte)) = self.to_host.receive_by(now_ns)
        {
            *place = byte;
            length += 1;
        }
        Ok(length)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        let now_ns = self.clock.now_ns();
        self.run_board_until(now_ns);
        if self.board.is_unplugged() {
            return Err(LinkFault::Gone);
        }
        let from_ns = self.bridge.map_or(now_ns, |bridge| bridge.leaves_bridge_ns(now_ns));
        self.to_board.send(bytes, from_ns);
        Ok(())
    }

    fn name(&self) -> &str {
        IN_PROCESS
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        BOOT_TIME_NS
    }
}

impl SerialLink<InProcessWire> {
    /// An emulated Qube in this process and in virtual time, behind the same link as a real one.
    #[must_use]
    pub fn in_process(settings: EmulatorSettings, clock: VirtualClock) -> Self {
        Self::new(InProcessWire::new(settings, clock.clone()), Arc::new(clock))
    }
}
