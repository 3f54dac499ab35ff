use firmware_protocol::{
    DeviceKind, HelloReply, PROTOCOL_VERSION, QUBE_MODULE_ID, RefusalReason, Reply, Request,
    StatusBits,
};

use super::device_time::DeviceTime;
use super::{ANSWER_TIME_NS, MS, SerialLink};
use crate::clock::Nanoseconds;
use crate::device::{AmplifierState, DeviceError, EMULATOR_KIND, Identity, LinkFault, Transport};

/// Interval between hellos, and between the samples that precede a hello, ns; a device that boots
/// misses some of them.
const HELLO_INTERVAL_NS: Nanoseconds = 100 * MS;

/// The operator's actions at the Qube's switches since the first hello, as far as an answer has
/// shown them. The record lasts as long as the link.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Seen {
    /// The emergency-stop switch was closed, or there is none.
    stop_closed: bool,
    /// The emergency-stop switch was opened after it had been closed.
    pub stop_opened: bool,
    /// The Qube was off while its board ran on.
    pub qube_off: bool,
}

/// The hellos of a link, and what the program must know before it sends one.
impl<T: Transport> SerialLink<T> {
    /// Sends a hello within an arm or disarm; fails if the device has restarted since the caller's
    /// last hello. Its counts may then start at any value, so the caller must send a hello of its
    /// own.
    pub(super) fn greet_same_start(&mut self) -> Result<(), DeviceError> {
        let (reply, counts_anew) = self.greet_unless_stopped()?;
        let identity = self.accept(&reply)?;
        if self.boot_id != Some(identity.boot_id) || counts_anew {
            self.arm_nonce = Err(RefusalReason::NotGreeted);
            self.has_restarted = true;
            return Err(self.restarted());
        }
        Ok(())
    }

    /// Sends a hello; returns its answer, and whether the Qube's counters have begun anew without a
    /// restart of the board. A sample precedes every hello after the first successful one, because
    /// a hello clears the device's latch of an emergency-stop switch that is closed again, and the
    /// state of a device whose Qube was off (PROTOCOL.md, "No Qube"). Without an answer to the
    /// sample no hello is sent: an operator may have used the switch while no answer arrived.
    ///
    /// # Errors
    /// The errors of [`greet`](Self::greet) and [`first_answer`](Self::first_answer); or the switch
    /// was opened, or the Qube switched off, since the first hello: only a new link moves this Qube
    /// again. A Qube that was off while the port was gone is not counted, since the operator is
    /// asked to switch it off then.
    pub(super) fn greet_unless_stopped(&mut self) -> Result<(HelloReply, bool), DeviceError> {
        let Some(boot_id) = self.boot_id else { return Ok((self.greet()?, false)) };
        match self.first_answer()? {
            Reply::Sample(sample) => {
                self.see_stop(sample.status.has(StatusBits::EMERGENCY_STOP));
            }
            Reply::Refusal { reason: RefusalReason::NotGreeted, .. } => self.was_ungreeted = true,
            Reply::Refusal { reason: RefusalReason::QubeAbsent, .. } => {
                self.seen.qube_off |= !self.was_reopened;
            }
            _ => {}
        }
        let port = self.name();
        if self.seen.stop_opened {
            return Err(DeviceError::StopOpened { port });
        }
        if self.seen.qube_off {
            return Err(DeviceError::SwitchedOff { port });
        }
        let reply = self.greet()?;
        let counts_anew = self.was_ungreeted && reply.boot_id == boot_id;
        if counts_anew && !self.was_reopened {
            self.seen.qube_off = true;
            return Err(DeviceError::SwitchedOff { port });
        }
        Ok((reply, counts_anew))
    }

    /// The first answer to a sample that shows the device's state, within the transport's boot
    /// time: the sample, or the refusal of a device that was not greeted or has no Qube.
    fn first_answer(&mut self) -> Result<Reply, DeviceError> {
        let wait_ns = self.transport.boot_time_ns();
        let end_ns = self.clock.now_ns() + wait_ns;
        let mut samples = 0;
        while self.clock.now_ns() < end_ns {
            // A delimiter ends the partial frame that a broken exchange may have left.
            self.broken_frame = true;
            let next_ns = self.clock.now_ns() + HELLO_INTERVAL_NS;
            samples += 1;
            match self.exchange(Request::Sample, ANSWER_TIME_NS) {
                Ok(
                    answer @ (Reply::Sample(_)
                    | Reply::Refusal {
                        reason: RefusalReason::NotGreeted | RefusalReason::QubeAbsent,
                        ..
                    }),
                ) => return Ok(answer),
                Err(LinkFault::Gone) => {
                    self.forget_start();
                    return Err(self.link_error(LinkFault::Gone));
                }
                Ok(_) | Err(_) => self.clock.sleep_until(next_ns.min(end_ns)),
            }
        }
        self.forget_start();
        Err(self.silence(&format!("no answer to {samples} samples"), wait_ns))
    }

    /// Repeats hellos until a reply to one comes or the transport's boot time is over; refusals do
    /// not count.
    fn greet(&mut self) -> Result<HelloReply, DeviceError> {
        // Any device may have restarted a moment ago, even if it has answered before.
        let wait_ns = self.transport.boot_time_ns();
        self.forget_start();
        let end_ns = self.clock.now_ns() + wait_ns;
        let (mut hellos, mut is_refused) = (0, false);
        while self.clock.now_ns() < end_ns {
            // A delimiter ends the partial frame that a terminal or a killed program may have left.
            self.broken_frame = true;
            let asked_ns = self.clock.now_ns();
            let left_ns = end_ns - asked_ns;
            let next_ns = asked_ns + HELLO_INTERVAL_NS.min(left_ns);
            let hello = Request::Hello { protocol_version: PROTOCOL_VERSION };
            hellos += 1;
            match self.exchange(hello, HELLO_INTERVAL_NS.min(left_ns)) {
                Ok(Reply::Hello(reply)) => return Ok(reply),
                Err(LinkFault::Timeout) => {}
                Ok(_) => {
                    is_refused = true;
                    self.clock.sleep_until(next_ns);
                }
                // The port accepts no more bytes because nobody reads at its other end.
                Err(LinkFault::Full) => self.clock.sleep_until(next_ns),
                Err(fault) => return Err(self.link_error(fault)),
            }
        }
        let nothing = if is_refused { "only refusals as" } else { "no" };
        Err(self.silence(&format!("{nothing} answer to {hellos} hellos"), wait_ns))
    }

    /// Clears the state that holds only for the device's start that the last hello greeted.
    fn forget_start(&mut self) {
        self.arm_nonce = Err(RefusalReason::NotGreeted);
        self.last_sample = None;
        self.is_emulator = false;
        self.amplifier = AmplifierState::Off;
        self.device_time = DeviceTime::default();
    }

    pub(super) fn see_stop(&mut self, is_open: bool) {
        self.seen.stop_closed |= !is_open;
        self.seen.stop_opened |= is_open && self.seen.stop_closed;
    }

    pub(super) fn accept(&mut self, reply: &HelloReply) -> Result<Identity, DeviceError> {
        if reply.protocol_version != PROTOCOL_VERSION {
            return Err(DeviceError::VersionMismatch {
                port: self.name(),
                theirs: reply.protocol_version,
                ours: PROTOCOL_VERSION,
            });
        }
        if reply.module_id != QUBE_MODULE_ID {
            return Err(DeviceError::QubeAbsent { port: self.name(), module_id: reply.module_id });
        }
        self.arm_nonce = Ok(reply.nonce);
        self.is_emulator = DeviceKind::from_wire(reply.kind) == Some(DeviceKind::Emulator);
        let [major, minor, patch] = reply.firmware_version;
        Ok(Identity {
            kind: kind_name(reply.kind),
            serial: format!("{:016x}", u64::from_be_bytes(reply.serial)),
            firmware_version: format!("{major}.{minor}.{patch}"),
            protocol_version: reply.protocol_version,
            boot_id: reply.boot_id,
            counts_anew: false,
            port: self.name(),
        })
    }
}

fn kind_name(kind: u8) -> String {
    match DeviceKind::from_wire(kind) {
        Some(DeviceKind::Emulator) => EMULATOR_KIND.into(),
        Some(DeviceKind::Atmega328p) => "atmega328p".into(),
        Some(DeviceKind::Atmega2560) => "atmega2560".into(),
        None => format!("kind {kind}"),
    }
}
