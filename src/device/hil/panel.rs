use std::sync::Arc;

use firmware_protocol::WATCHDOG_MS;

use super::card::{CallFailed, Calling, Card};
use super::library::{Channels, Library, TextProperty};
use super::{HilAddress, HilError};
use crate::clock::{Clock, Nanoseconds, since_1970};
use crate::device::{AmplifierState, Identity};
use crate::qube::{MAX_VOLTAGE_V, Measurement, Status};

/// Time limit of the library's watchdog, s, equal to the time limit of the boards' firmware.
const WATCHDOG_S: f64 = WATCHDOG_MS as f64 * 1e-3;

/// Time since the amplifier was armed or the last act succeeded, after which a sample checks,
/// before it reads, whether the watchdog has expired, ns. Acts come every 10 ms, so a running tick
/// does not spend time on this call.
const WATCHDOG_ASKED_AFTER_NS: Nanoseconds = 30_000_000;

/// Number of consecutive failed acts after which the amplifier is switched off: a voltage whose act
/// failed may not have reached the motor, which then keeps an older one.
const MAX_FAILED_ACTS: u32 = 2;

/// The reason why the library gave no sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NoSample {
    /// The card is not open, or is not valid to the library.
    Gone,
    /// The read failed, or gave a current or a velocity that is not finite.
    Failed,
}

/// The operations on the USB panel of a Qube: hello, arm, sample, act, off and close, each by calls
/// of its card. Only the thread that calls the library uses the value.
pub(super) struct Panel {
    library: Arc<Library>,
    address: HilAddress,
    calling: Arc<Calling>,
    clock: Arc<dyn Clock>,
    card: Option<Card>,
    amplifier: AmplifierState,
    /// Counts at the first read since the card was opened; all counts are reported relative to
    /// them. The card's own counters are never set, because a Servo 3 loses counts when they are.
    base_counts: Option<[i32; 2]>,
    /// Number that differs after each opening of the card.
    boot_id: u16,
    last: Measurement,
    /// Time of the last arm or successful act, ns.
    fed_ns: Nanoseconds,
    applied_mv: i16,
    /// Time from the last sample to the act that answered it, us, until the next sample reports it.
    sample_to_act_us: Option<u32>,
    failed_acts: u32,
    /// Reason why the last attempt to switch the amplifier off failed; `None` once one has
    /// succeeded.
    off_failed: Option<HilError>,
}

impl Panel {
    pub(super) fn new(
        library: Library,
        address: HilAddress,
        calling: Arc<Calling>,
        clock: Arc<dyn Clock>,
    ) -> Self {
        Self {
            library: Arc::new(library),
            address,
            calling,
            clock,
            card: None,
            amplifier: AmplifierState::Off,
            base_counts: None,
            boot_id: since_1970().unwrap_or_default().as_millis() as u16,
            last: Measurement::default(),
            fed_ns: 0,
            applied_mv: 0,
            sample_to_act_us: None,
            failed_acts: 0,
            off_failed: None,
        }
    }

    /// Opens the card unless a valid one is open, switches its amplifier off, and reads its
    /// identity and, after an opening, [`Self::base_counts`].
    pub(super) fn hello(&mut self) -> Result<Identity, HilError> {
        if let Some(card) = self.card.take_if(|card| !card.is_valid()) {
            card.close();
        }
        if self.card.is_none() {
            self.open()?;
        } else if self.off().is_err() {
            // A card that was unplugged may be valid to the library.
            self.close();
            self.open()?;
        }
        let identity = self.identity();
        match self.read() {
            Ok(channels) => {
                self.base_counts.get_or_insert(channels.counts);
                identity
            }
            Err(failed) => {
                let error = self.error(failed);
                self.close();
                Err(error)
            }
        }
    }

    fn open(&mut self) -> Result<(), HilError> {
        let card = Card::open(&self.library, &self.address, &self.calling, &self.clock)?;
        self.card = Some(card);
        self.base_counts = None;
        self.boot_id = self.boot_id.wrapping_add(1);
        let off = self.off();
        if off.is_err() {
            self.close();
        }
        off
    }

    fn identity(&self) -> Result<Identity, HilError> {
        let card = self.card()?;
        let serial = card.text(TextProperty::SerialNumber);
        let firmware_version = card.text(TextProperty::FirmwareVersion);
        Ok(Identity {
            kind: self.address.card().to_owned(),
            serial: serial.map_or_else(|| self.address.id().to_owned(), |serial| short(&serial)),
            firmware_version: firmware_version.map_or("unknown".into(), |version| short(&version)),
            protocol_version: 0,
            boot_id: self.boot_id,
            counts_anew: false,
            port: self.address.to_string(),
        })
    }

    fn card(&self) -> Result<&Card, HilError> {
        self.card.as_ref().ok_or_else(|| HilError::NotGreeted { port: self.address.to_string() })
    }

    fn error(&self, failed: CallFailed) -> HilError {
        let port = self.address.to_string();
        self.card
            .as_ref()
            .map_or(HilError::NotGreeted { port }, |card| card.error(&self.address, failed))
    }

    fn read(&self) -> Result<Channels, CallFailed> {
        match &self.card {
            Some(card) => card.read(),
            None => Err(CallFailed { function: super::card::Function("hil_read"), code: -1 }),
        }
    }

    /// Arms the amplifier at 0 V, with the watchdog running. After any error it calls
    /// [`Self::off`].
    pub(super) fn arm(&mut self) -> Result<(), HilError> {
        let armed = self.try_arm();
        if armed.is_err() {
            let _ = self.off();
        }
        armed
    }

    /// Takes the steps of [`Self::arm`] up to the first error, after which the amplifier may be on.
    fn try_arm(&mut self) -> Result<(), HilError> {
        let card = self.card()?;
        // The amplifier is enabled last: the output is then 0 V, the card's outputs for an expired
        // watchdog are set, and the watchdog runs.
        let enabled = card
            .watchdog_clear()
            .and_then(|()| card.write_voltage(0.0))
            .and_then(|()| card.set_expiration_states())
            .and_then(|()| card.watchdog_start(WATCHDOG_S))
            .and_then(|()| card.enable(true));
        enabled.map_err(|failed| self.error(failed))?;
        self.fed_ns = self.clock.now_ns();
        (self.amplifier, self.applied_mv, self.failed_acts) = (AmplifierState::Armed, 0, 0);
        self.sample_to_act_us = None;
        Ok(())
    }

    /// Reads one sample. Its status shows whether the watchdog is known to have expired. If the
    /// read fails or gives a number that is not finite in that state, the sample repeats all
    /// previous readings.
    pub(super) fn sample(&mut self) -> Result<Measurement, NoSample> {
        let Some(card) = &self.card else { return Err(NoSample::Gone) };
        let asked_ns = self.clock.now_ns();
        if self.amplifier == AmplifierState::Armed
            && asked_ns.saturating_sub(self.fed_ns) > WATCHDOG_ASKED_AFTER_NS
            && card.watchdog_is_expired()
        {
            self.amplifier = AmplifierState::Tripped;
        }
        let asked_ns = self.clock.now_ns();
        match card.read() {
            // The watches cannot evaluate a velocity or a current that is not a finite number.
            Ok(channels) if channels.are_numbers() => self.store(&channels),
            _ if self.amplifier == AmplifierState::Armed && card.watchdog_is_expired() => {
                self.amplifier = AmplifierState::Tripped;
            }
            _ if self.amplifier == AmplifierState::Tripped => {}
            _ if !card.is_valid() => return Err(NoSample::Gone),
            _ => return Err(NoSample::Failed),
        }
        if self.amplifier != AmplifierState::Armed {
            self.applied_mv = 0;
        }
        self.last.device_time_us = asked_ns / 1000;
        self.last.applied_mv = self.applied_mv;
        self.last.sample_to_act_us = self.sample_to_act_us.take();
        self.last.status.armed = self.amplifier == AmplifierState::Armed;
        self.last.status.watchdog_tripped = self.amplifier == AmplifierState::Tripped;
        Ok(self.last)
    }

    /// Stores the readings of the card's channels, with the counts relative to
    /// [`Self::base_counts`].
    fn store(&mut self, channels: &Channels) {
        let [theta_base, alpha_base] = *self.base_counts.get_or_insert(channels.counts);
        let [theta, alpha] = channels.counts;
        let [amplifier_fault, stall_detected, stall_error] = channels.flags;
        self.last = Measurement {
            theta_counts: theta.wrapping_sub(theta_base),
            alpha_counts: alpha.wrapping_sub(alpha_base),
            tachometer_counts_s: channels.tachometer_counts_s as i32,
            current_a: channels.current_a as f32,
            status: Status { amplifier_fault, stall_detected, stall_error, ..Status::default() },
            ..self.last
        };
    }

    /// Writes a voltage, mV, and feeds the watchdog only if the write succeeded: otherwise the
    /// motor may keep an old voltage, and the watchdog must stop it. Switches the amplifier off
    /// after [`MAX_FAILED_ACTS`] failures in a row. Does nothing unless the amplifier is armed and
    /// the voltage is within [`MAX_VOLTAGE_V`].
    pub(super) fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) {
        let voltage_v = f64::from(voltage_mv) * 1e-3;
        if self.amplifier != AmplifierState::Armed || voltage_v.abs() > MAX_VOLTAGE_V {
            return;
        }
        let Some(card) = &self.card else { return };
        let fed = card.write_voltage(voltage_v).and_then(|()| card.watchdog_reload());
        let now_ns = self.clock.now_ns();
        match fed {
            Ok(true) => {
                (self.fed_ns, self.applied_mv, self.failed_acts) = (now_ns, voltage_mv, 0);
                let late_us = (now_ns / 1000).saturating_sub(sampled_at_us);
                self.sample_to_act_us = Some(u32::try_from(late_us).unwrap_or(u32::MAX));
            }
            Ok(false) => self.amplifier = AmplifierState::Tripped,
            Err(_) if card.watchdog_is_expired() => self.amplifier = AmplifierState::Tripped,
            Err(_) => {
                self.failed_acts += 1;
                if self.failed_acts >= MAX_FAILED_ACTS {
                    let _ = self.off();
                }
            }
        }
    }

    /// Switches the amplifier off: disables it, writes 0 V, then stops the watchdog. If one of the
    /// two writes fails and the watchdog has expired, clears and starts the watchdog and makes both
    /// writes once more. If a write still fails, starts the watchdog, waits for twice its time
    /// limit, in which it should switch the amplifier off, and closes the card. If no card is open,
    /// the result is that of the last attempt.
    pub(super) fn off(&mut self) -> Result<(), HilError> {
        self.amplifier = AmplifierState::Off;
        self.applied_mv = 0;
        let Some(card) = &self.card else { return self.off_failed.clone().map_or(Ok(()), Err) };
        let mut off = switched_off(card);
        if off.is_err() && card.watchdog_is_expired() {
            // Clearing may restore the outputs' earlier values and with them drive the motor. So
            // the watchdog is started again by the next call, and both outputs are written directly
            // after it.
            let _ = card.watchdog_clear();
            let _ = card.watchdog_start(WATCHDOG_S);
            off = switched_off(card);
        }
        let Err(failed) = off else {
            let _ = card.watchdog_stop();
            self.off_failed = None;
            return Ok(());
        };
        let error = card.error(&self.address, failed);
        let _ = card.watchdog_start(WATCHDOG_S);
        self.clock.sleep_until(self.clock.now_ns() + 2 * (WATCHDOG_S * 1e9) as Nanoseconds);
        self.close();
        self.off_failed = Some(error.clone());
        Err(error)
    }

    /// Closes the card. It switches nothing off: [`Self::off`] has been tried before.
    pub(super) fn close(&mut self) {
        if let Some(card) = self.card.take() {
            card.close();
        }
        self.amplifier = AmplifierState::Off;
        self.base_counts = None;
    }
}

/// Disables the amplifier and writes 0 V, each even if the other fails. A disabled amplifier is off
/// at any voltage, while an enabled one at 0 V is not off.
fn switched_off(card: &Card) -> Result<(), CallFailed> {
    let disabled = card.enable(false);
    let at_zero = card.write_voltage(0.0);
    disabled.and(at_zero)
}

/// Shortens a text of the card for messages and file names: keeps the ASCII letters, digits and the
/// signs `.`, `_`, `-`, at most 64 of them, and drops all other characters.
fn short(text: &str) -> String {
    const LONGEST: usize = 64;
    let is_plain = |letter: &char| letter.is_ascii_alphanumeric() || "._-".contains(*letter);
    text.chars().filter(is_plain).take(LONGEST).collect()
}
