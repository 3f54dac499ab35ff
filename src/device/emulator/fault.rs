/// A fault of an emulated Qube or its board. Real Qubes and boards have the same faults.
///
/// Times are in seconds since the emulated Qube started. [`forms`](Self::forms) lists the text
/// forms, for example `silent@2`, `garble@10`, `wrong-version`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EmulatorFault {
    /// The program stops answering; only its watchdog works.
    Silent {
        /// Onset, s.
        after_s: f64,
    },
    /// One bit of each n-th reply arrives flipped.
    Garble {
        /// Interval n, replies.
        every: u32,
    },
    /// The firmware uses the previous version of the protocol.
    WrongVersion,
    /// The pendulum's encoder cable is loose: its count freezes.
    FrozenAlpha {
        /// Onset, s.
        after_s: f64,
    },
    /// The arm's encoder cable is loose: its count freezes, and its tachometer shows an arm at
    /// rest.
    FrozenTheta {
        /// Onset, s.
        after_s: f64,
    },
    /// The motor's circuit is open: no current flows, and nothing brakes the arm but friction.
    DeadMotor {
        /// Onset, s.
        after_s: f64,
    },
    /// The arm is blocked. At up to 5 V the Qube's own stall detection does not respond.
    BlockedArm {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube reports a permanent fault of its amplifier.
    AmplifierFault {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube reports a fault of its amplifier for a time, which may be shorter than a tick.
    LapsingAmplifierFault {
        /// Onset, s.
        after_s: f64,
        /// Duration, s.
        lasts_s: f64,
    },
    /// The Qube reports a stall and switches its motor off; the next arm clears the report. If the
    /// board was armed, a hello must precede that arm.
    StallError {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube does not answer the board.
    QubeAbsent {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube is switched off, and on again. Its counters then begin at 0, and the board must be
    /// greeted again.
    SwitchedOffAndOn {
        /// Onset, s.
        after_s: f64,
        /// Time for which the Qube is off, s.
        off_s: f64,
    },
    /// The USB cable is pulled from a board with its own supply: the port is gone, but the board
    /// runs on, and its watchdog switches the motor off. A board that is fed by USB loses its power
    /// instead: [`PowerLoss`](Self::PowerLoss).
    Unplugged {
        /// Onset, s.
        after_s: f64,
    },
    /// The board loses its supply, for instance with the USB cable that feeds it: the port is gone,
    /// and the Qube keeps the last motor command, because nothing replaces it.
    PowerLoss {
        /// Onset, s.
        after_s: f64,
    },
    /// The board's supply dips and its brown-out detector restarts it. Meanwhile the board's pins
    /// float, and the chip-select pull-up keeps the Qube from reading noise. So the last motor
    /// command stays until the program's first frame, 70 ms later.
    BrownOut {
        /// Onset, s.
        after_s: f64,
    },
    /// The reset pin restarts the board: its boot loader listens for 1 s, and the last motor
    /// command stays until the program's first frame.
    BoardRestart {
        /// Onset, s.
        after_s: f64,
    },
    /// The emergency-stop switch is pressed, and released after 2 s.
    EmergencyStop {
        /// Onset, s.
        after_s: f64,
    },
    /// The USB cable is pulled and plugged in again; the board has its own supply meanwhile.
    Replugged {
        /// Time at which the cable is pulled, s.
        after_s: f64,
        /// Time for which the cable stays out, s.
        away_s: f64,
    },
    /// The arm's encoder cable is loose: its count freezes, and its tachometer keeps the last
    /// velocity.
    StuckTheta {
        /// Onset, s.
        after_s: f64,
    },
    /// The arm's encoder cable is loose for a while; counts in that time are lost.
    LapsingTheta {
        /// Onset, s.
        after_s: f64,
        /// Duration, s.
        lasts_s: f64,
    },
    /// The pendulum's encoder cable is loose for a while; counts in that time are lost.
    LapsingAlpha {
        /// Onset, s.
        after_s: f64,
        /// Duration, s.
        lasts_s: f64,
    },
    /// The arm's count jumps.
    JumpTheta {
        /// Onset, s.
        after_s: f64,
        /// Size of the jump, counts.
        counts: i32,
    },
    /// The pendulum's count jumps.
    JumpAlpha {
        /// Onset, s.
        after_s: f64,
        /// Size of the jump, counts.
        counts: i32,
    },
    /// Disturbances on the cable of the arm's encoder are counted as motion; the tachometer does
    /// not show them.
    DriftingTheta {
        /// Onset, s.
        after_s: f64,
        /// Counts a second, 1 to 100 000 in either direction.
        counts_s: i32,
    },
    /// The motor has a bad contact: only a fraction of the current flows.
    WeakMotor {
        /// Fraction of the current, above 0 and at most 1.
        share: f64,
    },
    /// The amplifier drives in one direction only and gives 0 V in the other.
    OneSidedMotor {
        /// Onset, s.
        after_s: f64,
        /// True if the positive direction works.
        positive: bool,
    },
    /// The board drives the motor with a voltage of its own while it is armed, and reports it.
    StuckOutput {
        /// Onset, s.
        after_s: f64,
        /// Voltage at the motor, V, from -5 to 5.
        voltage_v: f64,
    },
    /// A disarm has no effect, and the board's answers to it report so; its watchdog works.
    IgnoredDisarm {
        /// Onset, s.
        after_s: f64,
    },
    /// The arm's encoder has another number of lines than a Qube's.
    ScaledTheta {
        /// Ratio of the encoder's counts to a Qube's, above 0 and at most 10.
        factor: f64,
    },
    /// A hand pushes the arm.
    PushedArm {
        /// Onset, s.
        after_s: f64,
        /// Duration, s.
        lasts_s: f64,
        /// Motor voltage that would push as strongly, V, positive towards positive theta.
        like_v: f64,
    },
    /// A hand holds the pendulum.
    HeldPendulum {
        /// Onset, s.
        after_s: f64,
        /// Duration, s.
        lasts_s: f64,
    },
    /// The arm's encoder is wired in reverse.
    FlippedTheta,
    /// The pendulum's encoder is wired in reverse.
    FlippedAlpha,
    /// The motor is wired in reverse.
    FlippedMotor,
    /// The encoders of arm and pendulum are plugged into each other's sockets.
    ExchangedEncoders,
}

impl EmulatorFault {
    /// Time at which the fault begins, us since the emulated Qube started; 0 for faults that exist
    /// from the start.
    #[must_use]
    pub fn onset_us(&self) -> u64 {
        match *self {
            Self::Garble { .. }
            | Self::WrongVersion
            | Self::FlippedTheta
            | Self::FlippedAlpha
            | Self::FlippedMotor
            | Self::ExchangedEncoders
            | Self::ScaledTheta { .. }
            | Self::WeakMotor { .. } => 0,
            Self::Silent { after_s }
            | Self::FrozenAlpha { after_s }
            | Self::FrozenTheta { after_s }
            | Self::StuckTheta { after_s }
            | Self::LapsingTheta { after_s, .. }
            | Self::LapsingAlpha { after_s, .. }
            | Self::JumpTheta { after_s, .. }
            | Self::JumpAlpha { after_s, .. }
            | Self::DriftingTheta { after_s, .. }
            | Self::DeadMotor { after_s }
            | Self::OneSidedMotor { after_s, .. }
            | Self::StuckOutput { after_s, .. }
            | Self::IgnoredDisarm { after_s }
            | Self::PushedArm { after_s, .. }
            | Self::HeldPendulum { after_s, .. }
            | Self::BlockedArm { after_s }
            | Self::AmplifierFault { after_s }
            | Self::LapsingAmplifierFault { after_s, .. }
            | Self::StallError { after_s }
            | Self::QubeAbsent { after_s }
            | Self::SwitchedOffAndOn { after_s, .. }
            | Self::Replugged { after_s, .. }
            | Self::Unplugged { after_s }
            | Self::PowerLoss { after_s }
            | Self::BrownOut { after_s }
            | Self::BoardRestart { after_s }
            | Self::EmergencyStop { after_s } => (after_s * 1e6) as u64,
        }
    }
}
