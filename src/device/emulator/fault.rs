use std::fmt;
use std::str::FromStr;

use thiserror::Error;

/// Default size of an encoder's jump, counts.
const USUAL_JUMP_COUNTS: i32 = 300;

/// Largest number in the text form of a fault, for times in s more than thirty years.
const LARGEST: f64 = 1e9;

/// A fault of an emulated Qube or its board. Real Qubes and boards have the same faults.
///
/// Times are in seconds since the emulated Qube started. [`forms`](Self::forms) lists the text
/// forms, for example `silent@2`, `garble@10`, `wrong-version`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EmulatorFault {
    /// The program stops answering; only its watchdog still works.
    Silent {
        /// Onset, s.
        after_s: f64,
    },
    /// One bit of each n-th reply arrives flipped.
    Garble {
        /// Interval n, replies.
        every: u32,
    },
    /// The firmware speaks the previous version of the protocol.
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
    /// The arm is blocked. At up to 5 V the Qube's own stall detection stays silent.
    BlockedArm {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube reports a permanent fault of its amplifier.
    AmplifierFault {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube reports a stall and switches its motor off; the next arm clears the report. If the
    /// board was armed, a hello must precede that arm.
    StallError {
        /// Onset, s.
        after_s: f64,
    },
    /// The Qube no longer answers the board.
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
    /// Disturbances on the cable of the arm's encoder are counted as motion; the tachometer does not
    /// show them.
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
        /// Whether the positive direction works.
        positive: bool,
    },
    /// The board drives the motor with a voltage of its own while it is armed, and reports it.
    StuckOutput {
        /// Onset, s.
        after_s: f64,
        /// Voltage at the motor, V, from -5 to 5.
        voltage_v: f64,
    },
    /// A disarm has no effect, as the board's answers to it say; its watchdog works.
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

/// The text form of each fault, and its effect. S, D, N, F and V are numbers: S is a time after the
/// start, s, D a duration, s, N a number of counts or replies, F a factor, V a voltage, V.
const FORMS: [(&str, &str); 28] = [
    ("silent@S", "answers nothing from S on"),
    ("garble@N", "a bit of each N-th reply is flipped"),
    ("wrong-version", "answers with the previous version of the protocol"),
    ("frozen-theta@S[+D]", "the arm's count stays [for D], its tachometer shows rest"),
    ("stuck-theta@S", "the arm's count stays, its tachometer too"),
    ("frozen-alpha@S[+D]", "the pendulum's count stays [for D]"),
    ("jump-theta@S[:N]", "the arm's count jumps by 300 or N"),
    ("jump-alpha@S[:N]", "the pendulum's count jumps by 300 or N"),
    ("drifting-theta@S[:N]", "the arm's count gains 300 or N counts a second, 1 to 100000"),
    ("scaled-theta@F", "the arm's encoder gives F times as many counts"),
    ("flipped-theta", "the arm's encoder is wired in reverse"),
    ("flipped-alpha", "the pendulum's encoder is wired in reverse"),
    ("flipped-motor", "the motor is wired in reverse"),
    ("exchanged-encoders", "the encoders of arm and pendulum are exchanged"),
    ("dead-motor@S", "no current flows"),
    ("weak-motor@F", "only the fraction F of the current flows"),
    ("one-sided-motor@S:+|-", "only voltages of this sign drive"),
    ("stuck-output@S:V", "an armed board drives with V volts, whatever it is told"),
    ("ignored-disarm@S", "a disarm has no effect, and the board says so"),
    ("blocked-arm@S", "something holds the arm"),
    ("pushed-arm@S+D:V", "a hand pushes the arm as V volts would"),
    ("held-pendulum@S+D", "a hand holds the pendulum"),
    ("amplifier@S", "the amplifier reports a fault"),
    ("stall@S", "the Qube reports a stall"),
    ("qube-absent@S[+D]", "the Qube does not answer its board [is off for D]"),
    ("unplug@S[+D]", "the USB cable is pulled [for D]"),
    ("power-loss@S, brown-out@S, board-restart@S", "the board loses power for good, or restarts"),
    ("emergency-stop@S", "the emergency-stop switch is pressed for 2 s"),
];

/// The error for a text that names no fault, or whose numbers are out of range.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "{text} is not a fault, or a number in it is out of range. The faults, with times in s and voltages \
     in V, are:\n{}",
    EmulatorFault::forms()
)]
pub struct UnknownFault {
    /// Text given.
    pub text: String,
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

impl EmulatorFault {
    /// The text forms of all faults, one a line, each with its effect.
    #[must_use]
    pub fn forms() -> String {
        let lines = FORMS.map(|(form, effect)| format!("  {form:22} {effect}"));
        lines.join("\n")
    }
}

impl fmt::Display for EmulatorFault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Silent { after_s } => write!(formatter, "silent@{after_s}"),
            Self::Garble { every } => write!(formatter, "garble@{every}"),
            Self::WrongVersion => write!(formatter, "wrong-version"),
            Self::FrozenAlpha { after_s } => write!(formatter, "frozen-alpha@{after_s}"),
            Self::FrozenTheta { after_s } => write!(formatter, "frozen-theta@{after_s}"),
            Self::DeadMotor { after_s } => write!(formatter, "dead-motor@{after_s}"),
            Self::BlockedArm { after_s } => write!(formatter, "blocked-arm@{after_s}"),
            Self::AmplifierFault { after_s } => write!(formatter, "amplifier@{after_s}"),
            Self::StallError { after_s } => write!(formatter, "stall@{after_s}"),
            Self::QubeAbsent { after_s } => write!(formatter, "qube-absent@{after_s}"),
            Self::SwitchedOffAndOn { after_s, off_s } => {
                write!(formatter, "qube-absent@{after_s}+{off_s}")
            }
            Self::Unplugged { after_s } => write!(formatter, "unplug@{after_s}"),
            Self::PowerLoss { after_s } => write!(formatter, "power-loss@{after_s}"),
            Self::BrownOut { after_s } => write!(formatter, "brown-out@{after_s}"),
            Self::BoardRestart { after_s } => write!(formatter, "board-restart@{after_s}"),
            Self::EmergencyStop { after_s } => write!(formatter, "emergency-stop@{after_s}"),
            Self::Replugged { after_s, away_s } => write!(formatter, "unplug@{after_s}+{away_s}"),
            Self::FlippedTheta => write!(formatter, "flipped-theta"),
            Self::FlippedAlpha => write!(formatter, "flipped-alpha"),
            Self::FlippedMotor => write!(formatter, "flipped-motor"),
            Self::ExchangedEncoders => write!(formatter, "exchanged-encoders"),
            Self::StuckTheta { after_s } => write!(formatter, "stuck-theta@{after_s}"),
            Self::LapsingTheta { after_s, lasts_s } => {
                write!(formatter, "frozen-theta@{after_s}+{lasts_s}")
            }
            Self::LapsingAlpha { after_s, lasts_s } => {
                write!(formatter, "frozen-alpha@{after_s}+{lasts_s}")
            }
            Self::JumpTheta { after_s, counts } => {
                write!(formatter, "jump-theta@{after_s}:{counts}")
            }
            Self::JumpAlpha { after_s, counts } => {
                write!(formatter, "jump-alpha@{after_s}:{counts}")
            }
            Self::DriftingTheta { after_s, counts_s } => {
                write!(formatter, "drifting-theta@{after_s}:{counts_s}")
            }
            Self::WeakMotor { share } => write!(formatter, "weak-motor@{share}"),
            Self::OneSidedMotor { after_s, positive } => {
                write!(formatter, "one-sided-motor@{after_s}:{}", if *positive { '+' } else { '-' })
            }
            Self::StuckOutput { after_s, voltage_v } => {
                write!(formatter, "stuck-output@{after_s}:{voltage_v}")
            }
            Self::IgnoredDisarm { after_s } => write!(formatter, "ignored-disarm@{after_s}"),
            Self::ScaledTheta { factor } => write!(formatter, "scaled-theta@{factor}"),
            Self::PushedArm { after_s, lasts_s, like_v } => {
                write!(formatter, "pushed-arm@{after_s}+{lasts_s}:{like_v}")
            }
            Self::HeldPendulum { after_s, lasts_s } => {
                write!(formatter, "held-pendulum@{after_s}+{lasts_s}")
            }
        }
    }
}

impl FromStr for EmulatorFault {
    type Err = UnknownFault;

    fn from_str(text: &str) -> Result<Self, UnknownFault> {
        let unknown = || UnknownFault { text: text.to_owned() };
        let (name, value) = match text.split_once('@') {
            Some((name, value)) => (name, Some(value)),
            None => (text, None),
        };
        let parsed = |text: &str| {
            let seconds = text.parse::<f64>().ok();
            seconds.filter(|after_s| (0.0..=LARGEST).contains(after_s)).ok_or_else(unknown)
        };
        let number = |value: &str| {
            value.parse::<f64>().ok().filter(|number| (0.0..=LARGEST).contains(number))
        };
        // The form S+D: from S on, for the duration D.
        let lapse = || {
            let (after, lasts) = value?.split_once('+')?;
            Some((number(after)?, number(lasts)?))
        };
        // The form S:N, or S for the default jump.
        let jump = || {
            let (after, counts) = match value?.split_once(':') {
                Some((after, counts)) => (after, counts.parse().ok()?),
                None => (value?, USUAL_JUMP_COUNTS),
            };
            Some((number(after)?, counts))
        };
        let seconds = || value.ok_or_else(unknown).and_then(parsed);
        Ok(match name {
            "silent" => Self::Silent { after_s: seconds()? },
            "garble" => Self::Garble {
                every: value
                    .and_then(|value| value.parse().ok())
                    .filter(|every| *every > 0)
                    .ok_or_else(unknown)?,
            },
            "wrong-version" if value.is_none() => Self::WrongVersion,
            "flipped-theta" if value.is_none() => Self::FlippedTheta,
            "flipped-alpha" if value.is_none() => Self::FlippedAlpha,
            "flipped-motor" if value.is_none() => Self::FlippedMotor,
            "exchanged-encoders" if value.is_none() => Self::ExchangedEncoders,
            "frozen-alpha" => match lapse() {
                Some((after_s, lasts_s)) => Self::LapsingAlpha { after_s, lasts_s },
                None => Self::FrozenAlpha { after_s: seconds()? },
            },
            "frozen-theta" => match lapse() {
                Some((after_s, lasts_s)) => Self::LapsingTheta { after_s, lasts_s },
                None => Self::FrozenTheta { after_s: seconds()? },
            },
            "stuck-theta" => Self::StuckTheta { after_s: seconds()? },
            "jump-theta" => {
                let (after_s, counts) = jump().ok_or_else(unknown)?;
                Self::JumpTheta { after_s, counts }
            }
            "jump-alpha" => {
                let (after_s, counts) = jump().ok_or_else(unknown)?;
                Self::JumpAlpha { after_s, counts }
            }
            "drifting-theta" => {
                let (after_s, counts_s) = jump()
                    .filter(|(_, counts_s)| (1..=100_000).contains(&counts_s.abs()))
                    .ok_or_else(unknown)?;
                Self::DriftingTheta { after_s, counts_s }
            }
            "weak-motor" => Self::WeakMotor {
                share: seconds()
                    .ok()
                    .filter(|share| *share > 0.0 && *share <= 1.0)
                    .ok_or_else(unknown)?,
            },
            "one-sided-motor" => {
                let (after, side) =
                    value.and_then(|value| value.split_once(':')).ok_or_else(unknown)?;
                let positive = match side {
                    "+" => true,
                    "-" => false,
                    _ => return Err(unknown()),
                };
                Self::OneSidedMotor { after_s: parsed(after)?, positive }
            }
            "stuck-output" => {
                let (after, volts) =
                    value.and_then(|value| value.split_once(':')).ok_or_else(unknown)?;
                let voltage_v = volts.parse().ok().filter(|volts| (-5.0..=5.0).contains(volts));
                let voltage_v = voltage_v.ok_or_else(unknown)?;
                Self::StuckOutput { after_s: parsed(after)?, voltage_v }
            }
            "ignored-disarm" => Self::IgnoredDisarm { after_s: seconds()? },
            "scaled-theta" => Self::ScaledTheta {
                factor: seconds()
                    .ok()
                    .filter(|factor| *factor > 0.0 && *factor <= 10.0)
                    .ok_or_else(unknown)?,
            },
            "pushed-arm" => {
                let (lapse, volts) =
                    value.and_then(|value| value.split_once(':')).ok_or_else(unknown)?;
                let (after, lasts) = lapse.split_once('+').ok_or_else(unknown)?;
                let like_v = volts.parse::<f64>().ok().filter(|like_v| like_v.is_finite());
                Self::PushedArm {
                    after_s: parsed(after)?,
                    lasts_s: parsed(lasts)?,
                    like_v: like_v.ok_or_else(unknown)?,
                }
            }
            "held-pendulum" => {
                let (after_s, lasts_s) = lapse().ok_or_else(unknown)?;
                Self::HeldPendulum { after_s, lasts_s }
            }
            "dead-motor" => Self::DeadMotor { after_s: seconds()? },
            "blocked-arm" => Self::BlockedArm { after_s: seconds()? },
            "amplifier" => Self::AmplifierFault { after_s: seconds()? },
            "stall" => Self::StallError { after_s: seconds()? },
            "qube-absent" => match lapse() {
                Some((after_s, off_s)) => Self::SwitchedOffAndOn { after_s, off_s },
                None => Self::QubeAbsent { after_s: seconds()? },
            },
            "unplug" if value.is_some_and(|value| value.contains('+')) => {
                let (after, away) =
                    value.and_then(|value| value.split_once('+')).unwrap_or_default();
                Self::Replugged { after_s: parsed(after)?, away_s: parsed(away)? }
            }
            "unplug" => Self::Unplugged { after_s: seconds()? },
            "power-loss" => Self::PowerLoss { after_s: seconds()? },
            "brown-out" => Self::BrownOut { after_s: seconds()? },
            "board-restart" => Self::BoardRestart { after_s: seconds()? },
            "emergency-stop" => Self::EmergencyStop { after_s: seconds()? },
            _ => return Err(unknown()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fault_is_read_as_it_is_written() {
        for text in [
            "silent@2",
            "qube-absent@2+0.5",
            "garble@10",
            "wrong-version",
            "frozen-alpha@0.5",
            "frozen-theta@0",
            "dead-motor@2",
            "blocked-arm@1",
            "amplifier@3",
            "stall@3",
            "qube-absent@0",
            "unplug@1.25",
            "power-loss@2",
            "brown-out@2.5",
            "board-restart@3",
            "emergency-stop@4",
            "unplug@5+3",
            "flipped-theta",
            "flipped-alpha",
            "flipped-motor",
            "exchanged-encoders",
            "stuck-theta@2.5",
            "frozen-theta@2+0.5",
            "frozen-alpha@3+0.5",
            "jump-theta@4:300",
            "jump-alpha@4:-120",
            "drifting-theta@4:-150",
            "weak-motor@0.3",
            "one-sided-motor@2:+",
            "one-sided-motor@0:-",
            "stuck-output@3:1.5",
            "ignored-disarm@2",
            "scaled-theta@0.5",
            "pushed-arm@3+0.5:-2",
            "held-pendulum@3+0.5",
        ] {
            assert_eq!(text.parse::<EmulatorFault>().unwrap().to_string(), text);
            let name = text.split('@').next().unwrap();
            assert!(EmulatorFault::forms().contains(name), "{name} is not listed");
        }
        let forms = EmulatorFault::forms();
        let names = forms.split([' ', ',', '\n']).filter(|word| word.contains('@'));
        for name in names.map(|word| word.split('@').next().unwrap()) {
            let may_be =
                ["@1", "@0.5", "@1:+", "@1:1", "@1+1:1", "@1+1"].map(|end| format!("{name}{end}"));
            let is_known = may_be.iter().any(|text| text.parse::<EmulatorFault>().is_ok());
            assert!(is_known, "{name} is listed and unknown");
        }
        for text in [
            "",
            "unplug@5+",
            "unplug@+3",
            "silent",
            "silent@-1",
            "silent@nan",
            "garble@0",
            "wrong-version@1",
            "x@1",
            "jump-theta",
            "drifting-theta@2:0",
            "drifting-theta@2:2000000000",
            "weak-motor@2",
            "one-sided-motor@2",
            "scaled-theta@0",
            "stuck-output@2",
            "stuck-output@2:7",
            "pushed-arm@2+1",
            "frozen-alpha@1+",
            "silent@1e20",
            "qube-absent@2+1e20",
        ] {
            assert_eq!(text.parse::<EmulatorFault>(), Err(UnknownFault { text: text.to_owned() }));
        }
    }
}
