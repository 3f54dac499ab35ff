use firmware_protocol::scaling::{
    MAX_VOLTAGE_MV, current_ma, motor_counts, motor_voltage_mv, tachometer_counts_s,
};
use firmware_protocol::{
    Decoder, DeviceKind, DeviceState, DisarmReply, EncodedFrame, Frame, HelloReply, NO_ACT_US,
    PROTOCOL_VERSION, ParseError, QUBE_MODULE_ID, RefusalReason, Reply, Request, SampleReply,
    StatusBits, WATCHDOG_MS, answers_fresh_sample, is_newer,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{EmulatedPlant, EmulatorFault, EmulatorSettings};

mod failing;

const WATCHDOG_US: u64 = WATCHDOG_MS as u64 * 1000;

/// Lowest message type of replies. A board that receives a reply receives it from another device,
/// or as an echo.
const FIRST_REPLY_TYPE: u8 = 0x80;

/// Random stream of the nonces, separate from the plant's.
const NONCE_STREAM: u64 = 1;

/// Random stream of the boot id and of the counters' shifts at a restart.
const START_STREAM: u64 = 3;

/// Largest shift of the counts at a restart, counts: the protocol does not promise that counts
/// continue, so no host may rely on it.
const RESTART_COUNTS: i32 = 400;

/// The emulated board: the microcontroller's program, and the emulated Qube that it drives. The
/// board takes bytes, returns replies, and has a clock of its own.
///
/// The board performs no I/O: its owner advances its clock and delivers bytes at their time of
/// arrival.
#[derive(Clone, Debug)]
pub struct Board {
    settings: EmulatorSettings,
    plant: EmulatedPlant,
    decoder: Decoder,
    nonces: ChaCha8Rng,
    starts: ChaCha8Rng,
    boot_id: u16,
    now_us: u64,
    /// Time at which the program started, us; the program's clock counts from here.
    booted_us: u64,
    /// Time until which the program does not run, us; `u64::MAX` means that the program never
    /// starts again, and `None` that it runs. While the program does not run, the Qube keeps its
    /// last motor command.
    dark_until_us: Option<u64>,
    state: DeviceState,
    /// Nonce for the next arm; 0 is none.
    nonce: u32,
    watchdog_tripped: bool,
    fault_began: bool,
    /// True if an amplifier fault has led to Faulted since the last hello or restart.
    amplifier_failed: bool,
    stall_error: bool,
    frozen_theta_counts: Option<i32>,
    /// Latched state of the emergency stop.
    emergency_stop: bool,
    frozen_alpha_counts: Option<i32>,
    /// Time at which a Qube that is switched off is switched on again, us.
    qube_returns_us: Option<u64>,
    /// Shifts that the last start of board or Qube added to the counts, counts.
    theta_shift: i32,
    alpha_shift: i32,
    watchdog_fed_us: u64,
    /// Time at which the amplifier last went off, us; a restart counts only if a voltage was at the
    /// motor.
    switched_off_us: Option<u64>,
    motor_counts: i16,
    last_act_sequence: u16,
    /// Time of the last sample sent, us, until an act answers it or a hello or restart discards it;
    /// `sample_to_act_us` counts from it.
    previous_sample_us: Option<u64>,
    /// Time of the last sample sent since the last hello or restart, by the device's clock, us; an
    /// act must name this time.
    given_us: Option<u32>,
    sample_to_act_us: u16,
    dropped_frames: u16,
    replies: u32,
}

impl Board {
    /// A board that has just started, with its Qube in the initial state of the settings.
    #[must_use]
    pub fn new(settings: EmulatorSettings) -> Self {
        let mut nonces = ChaCha8Rng::seed_from_u64(settings.seed);
        nonces.set_stream(NONCE_STREAM);
        let mut starts = nonces.clone();
        starts.set_stream(START_STREAM);
        let mut board = Self {
            plant: EmulatedPlant::new(&settings),
            settings,
            decoder: Decoder::new(),
            nonces,
            boot_id: starts.random(),
            starts,
            now_us: 0,
            booted_us: 0,
            dark_until_us: None,
            state: DeviceState::Idle,
            nonce: 0,
            watchdog_tripped: false,
            fault_began: false,
            amplifier_failed: false,
            stall_error: false,
            frozen_theta_counts: None,
            emergency_stop: false,
            frozen_alpha_counts: None,
            qube_returns_us: None,
            theta_shift: 0,
            alpha_shift: 0,
            watchdog_fed_us: 0,
            switched_off_us: None,
            motor_counts: 0,
            last_act_sequence: 0,
            previous_sample_us: None,
            given_us: None,
            sample_to_act_us: NO_ACT_US,
            dropped_frames: 0,
            replies: 0,
        };
        board.advance_to(0);
        board
    }

    /// Advances the clock to `now_us`, us; a time in the past changes nothing. Watchdog, fault, and
    /// restarts of board and Qube take effect at their own times on the way.
    pub fn advance_to(&mut self, now_us: u64) {
        while let Some(event_us) = self.next_event_us().filter(|event_us| *event_us <= now_us) {
            self.now_us = self.now_us.max(event_us);
            if self.watchdog_deadline_us() == Some(event_us) {
                self.watchdog_tripped = true;
                self.leave_armed(DeviceState::Tripped);
            } else if self.dark_until_us == Some(event_us) {
                self.boot();
            } else if self.qube_returns_us == Some(event_us) {
                self.switch_on();
            } else {
                self.begin_fault();
            }
        }
        self.now_us = self.now_us.max(now_us);
    }

    /// Time at which the watchdog trips, the fault begins, or board or Qube start again, whichever
    /// is next, us; `None` if none is due. At that time the owner calls
    /// [`advance_to`](Self::advance_to), even without traffic.
    #[must_use]
    pub fn next_event_us(&self) -> Option<u64> {
        let fault_us =
            self.settings.fault.filter(|_| !self.fault_began).map(|fault| fault.onset_us());
        let boot_us = self.dark_until_us.filter(|until_us| *until_us < u64::MAX);
        let switched_on_us = self.qube_returns_us;
        [self.watchdog_deadline_us(), fault_us, boot_us, switched_on_us].into_iter().flatten().min()
    }

    fn watchdog_deadline_us(&self) -> Option<u64> {
        (self.state == DeviceState::Armed).then_some(self.watchdog_fed_us + WATCHDOG_US)
    }

    /// Takes a byte that has arrived; returns the reply if the byte completes a request that is
    /// answered. The reply starts at once.
    pub fn receive(&mut self, byte: u8) -> Option<EncodedFrame> {
        if self.dark_until_us.is_some() {
            return None;
        }
        let decoded = self.decoder.push(byte)?;
        if self.has_begun(|fault| matches!(fault, EmulatorFault::Silent { .. })) {
            return None;
        }
        let frame = match decoded {
            Ok(frame) if frame.message_type < FIRST_REPLY_TYPE => frame,
            Ok(_) | Err(_) => {
                self.dropped_frames = self.dropped_frames.wrapping_add(1);
                return None;
            }
        };
        let reply = self.answer(&frame)?.encode(frame.sequence);
        self.replies = self.replies.wrapping_add(1);
        Some(reply)
    }

    /// The Qube at the current time, with the true state that the wire does not show.
    pub fn plant(&mut self) -> &EmulatedPlant {
        self.plant.advance_to(self.now_us);
        &self.plant
    }

    /// The state of the protocol.
    #[must_use]
    pub fn state(&self) -> DeviceState {
        self.state
    }

    /// Time of the last accepted arm or act, by the board's clock, us; 0 before the first.
    #[must_use]
    pub fn last_command_us(&self) -> u64 {
        self.watchdog_fed_us
    }

    /// Time at which the amplifier last went off, by the board's clock, us; `None` if it has not
    /// gone off yet. A restart counts only if a voltage was at the motor.
    #[must_use]
    pub fn switched_off_us(&self) -> Option<u64> {
        self.switched_off_us
    }

    /// The voltage that the board commands, mV, in steps of the motor's counts; 0 while the
    /// amplifier is off.
    #[must_use]
    pub fn applied_mv(&self) -> i16 {
        motor_voltage_mv(self.motor_counts)
    }

    fn answer(&mut self, frame: &Frame) -> Option<Reply> {
        let request = match Request::parse(frame) {
            Ok(request) => request,
            Err(ParseError::UnknownType(_)) => {
                return Some(refusal(frame, RefusalReason::UnknownType));
            }
            Err(ParseError::WrongLength(_) | ParseError::BadField(_)) => {
                return Some(refusal(frame, RefusalReason::WrongLength));
            }
        };
        let answered = match request {
            Request::Hello { protocol_version } => Ok(Some(self.hello(protocol_version))),
            Request::Arm { nonce } => self.arm(nonce, frame.sequence).map(Some),
            Request::Sample => self.sample().map(Some),
            Request::Act { voltage_mv, sampled_at_us } => {
                self.act(voltage_mv, sampled_at_us, frame.sequence).map(|()| None)
            }
            Request::Disarm => Ok(Some(self.disarm())),
        };
        answered.unwrap_or_else(|reason| Some(refusal(frame, reason)))
    }

    fn hello(&mut self, host_version: u16) -> Reply {
        let version = match self.settings.fault {
            Some(EmulatorFault::WrongVersion) => PROTOCOL_VERSION - 1,
            _ => PROTOCOL_VERSION,
        };
        let understood = host_version == version;
        self.leave_armed(if understood { DeviceState::Greeted } else { DeviceState::Idle });
        self.amplifier_failed = false;
        self.nonce = if understood { self.new_nonce() } else { 0 };
        self.previous_sample_us = None;
        self.given_us = None;
        self.sample_to_act_us = NO_ACT_US;
        self.last_act_sequence = 0;
        if understood && self.stop_is_closed() {
            self.emergency_stop = false;
        }
        Reply::Hello(HelloReply {
            protocol_version: version,
            firmware_version: firmware_version(),
            kind: DeviceKind::Emulator as u8,
            module_id: if self.qube_absent() { 0 } else { QUBE_MODULE_ID },
            serial: self.settings.seed.to_be_bytes(),
            nonce: self.nonce,
            boot_id: self.boot_id,
            dropped_frames: self.dropped_frames,
        })
    }

    fn arm(&mut self, nonce: u32, sequence: u16) -> Result<Reply, RefusalReason> {
        match self.state {
            DeviceState::Idle => return Err(RefusalReason::NotGreeted),
            DeviceState::Armed => return Err(RefusalReason::AlreadyArmed),
            DeviceState::Tripped => return Err(RefusalReason::WatchdogTripped),
            DeviceState::Faulted => return Err(RefusalReason::Faulted),
            DeviceState::Greeted => {}
        }
        if nonce == 0 || nonce != self.nonce {
            return Err(RefusalReason::WrongNonce);
        }
        if self.qube_absent() {
            return Err(RefusalReason::QubeAbsent);
        }
        if self.emergency_stop {
            return Err(RefusalReason::EmergencyStop);
        }
        if self.amplifier_fault() {
            return Err(RefusalReason::Faulted);
        }
        self.nonce = 0;
        self.stall_error = false;
        self.watchdog_tripped = false;
        self.state = DeviceState::Armed;
        self.watchdog_fed_us = self.now_us;
        self.last_act_sequence = sequence;
        Ok(Reply::Arm { device_time_us: self.device_time_us() })
    }

    fn sample(&mut self) -> Result<Reply, RefusalReason> {
        if self.state == DeviceState::Idle {
            return Err(RefusalReason::NotGreeted);
        }
        if self.qube_absent() {
            return Err(RefusalReason::QubeAbsent);
        }
        self.plant.advance_to(self.now_us);
        let theta_sense = self.sense(EmulatorFault::FlippedTheta);
        let alpha_sense = self.sense(EmulatorFault::FlippedAlpha);
        let sample = SampleReply {
            device_time_us: self.device_time_us(),
            theta_counts: theta_sense
                * self.frozen_theta_counts.unwrap_or_else(|| self.plant.theta_counts())
                + self.theta_shift,
            alpha_counts: alpha_sense
                * self.frozen_alpha_counts.unwrap_or_else(|| self.plant.alpha_counts())
                + self.alpha_shift,
            tachometer_counts_s: match self.frozen_theta_counts {
                None => theta_sense * tachometer_counts_s(self.plant.tachometer_raw()),
                Some(_) => 0,
            },
            current_ma: self.sense(EmulatorFault::FlippedMotor) as i16
                * current_ma(self.plant.current_raw()),
            status: self.status(),
            applied_mv: motor_voltage_mv(self.motor_counts),
            last_act_sequence: self.last_act_sequence,
            sample_to_act_us: self.sample_to_act_us,
        };
        self.previous_sample_us = Some(self.now_us);
        self.given_us = Some(sample.device_time_us);
        self.sample_to_act_us = NO_ACT_US;
        Ok(Reply::Sample(sample))
    }

    fn act(
        &mut self,
        voltage_mv: i16,
        sampled_at_us: u32,
        sequence: u16,
    ) -> Result<(), RefusalReason> {
        match self.state {
            DeviceState::Idle => return Err(RefusalReason::NotGreeted),
            DeviceState::Greeted => return Err(RefusalReason::NotArmed),
            DeviceState::Tripped => return Err(RefusalReason::WatchdogTripped),
            DeviceState::Faulted => return Err(RefusalReason::Faulted),
            DeviceState::Armed => {}
        }
        if !is_newer(sequence, self.last_act_sequence) {
            return Err(RefusalReason::StaleSequence);
        }
        if !(-MAX_VOLTAGE_MV..=MAX_VOLTAGE_MV).contains(&voltage_mv) {
            return Err(RefusalReason::VoltageOutOfRange);
        }
        if !answers_fresh_sample(sampled_at_us, self.given_us, self.device_time_us()) {
            return Err(RefusalReason::StaleSample);
        }
        self.last_act_sequence = sequence;
        self.watchdog_fed_us = self.now_us;
        if let Some(sample_us) = self.previous_sample_us.take() {
            let elapsed_us = (self.now_us - sample_us).min(u64::from(NO_ACT_US) - 1);
            self.sample_to_act_us = elapsed_us as u16;
        }
        self.drive(self.stuck_output_counts().unwrap_or(motor_counts(voltage_mv)));
        Ok(())
    }

    fn disarm(&mut self) -> Reply {
        if self.state == DeviceState::Armed && !self.ignores_disarm() {
            self.leave_armed(DeviceState::Greeted);
            self.nonce = self.new_nonce();
        }
        Reply::Disarm(DisarmReply {
            state: self.state,
            nonce: self.nonce,
            dropped_frames: self.dropped_frames,
        })
    }

    /// Switches the motor off and enters another state.
    fn leave_armed(&mut self, next: DeviceState) {
        if self.state == DeviceState::Armed {
            self.switched_off_us = Some(self.now_us);
        }
        self.drive(0);
        self.state = next;
    }

    fn drive(&mut self, motor_counts: i16) {
        self.plant.advance_to(self.now_us);
        self.motor_counts = motor_counts;
        let sense = f64::from(self.sense(EmulatorFault::FlippedMotor));
        self.plant.set_voltage(sense * f64::from(motor_voltage_mv(motor_counts)) * 1e-3);
    }

    /// The program's clock in the wire's format: 32 bits, us.
    fn device_time_us(&self) -> u32 {
        (self.now_us - self.booted_us) as u32
    }

    /// Stops the program until `until_us`, us; the Qube keeps its last motor command.
    fn stop_program(&mut self, until_us: u64) {
        self.dark_until_us = Some(until_us);
        self.state = DeviceState::Idle;
        self.decoder.reset();
    }

    /// Starts the program: the first frame switches the motor off, and the program has forgotten
    /// everything that is not in its EEPROM. The Qube itself latches a stall error, which only an
    /// arm clears.
    fn boot(&mut self) {
        if self.motor_counts != 0 {
            self.switched_off_us = Some(self.now_us);
        }
        self.drive(0);
        self.dark_until_us = None;
        self.booted_us = self.now_us;
        self.boot_id = self.boot_id.wrapping_add(1);
        self.theta_shift = self.starts.random_range(-RESTART_COUNTS..=RESTART_COUNTS);
        self.alpha_shift = self.starts.random_range(-RESTART_COUNTS..=RESTART_COUNTS);
        self.nonce = 0;
        self.watchdog_tripped = false;
        self.amplifier_failed = false;
        self.emergency_stop = false;
        self.last_act_sequence = 0;
        self.previous_sample_us = None;
        self.given_us = None;
        self.sample_to_act_us = NO_ACT_US;
        self.dropped_frames = 0;
    }

    fn new_nonce(&mut self) -> u32 {
        loop {
            let nonce = self.nonces.random::<u32>();
            if nonce != 0 && nonce != self.nonce {
                return nonce;
            }
        }
    }

    fn status(&self) -> StatusBits {
        let bit = |bit: u8, is_set: bool| if is_set { bit } else { 0 };
        StatusBits(
            bit(StatusBits::ARMED, self.state == DeviceState::Armed)
                | bit(StatusBits::WATCHDOG_TRIPPED, self.watchdog_tripped)
                | bit(StatusBits::AMPLIFIER_FAULT, self.amplifier_fault() || self.amplifier_failed)
                | bit(StatusBits::STALL_DETECTED, self.stall_error)
                | bit(StatusBits::STALL_ERROR, self.stall_error)
                | bit(StatusBits::EMERGENCY_STOP, self.emergency_stop)
                | bit(
                    StatusBits::STOP_SWITCH_FITTED,
                    matches!(self.settings.fault, Some(EmulatorFault::EmergencyStop { .. })),
                ),
        )
    }
}

fn refusal(frame: &Frame, reason: RefusalReason) -> Reply {
    Reply::Refusal { refused_type: frame.message_type, reason }
}

/// The version of this program, with which the emulator is released.
fn firmware_version() -> [u8; 3] {
    let mut parts = env!("CARGO_PKG_VERSION").split('.').map(|part| part.parse().unwrap_or(0));
    std::array::from_fn(|_| parts.next().unwrap_or(0))
}

#[cfg(test)]
mod tests;
