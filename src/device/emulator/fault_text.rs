//! The text forms of an emulated Qube's faults, as `--fault` takes them.

use std::fmt;
use std::str::FromStr;

use thiserror::Error;

use super::EmulatorFault;

/// Default size of an encoder's jump, counts, and of its drift, counts/s.
const USUAL_COUNTS: i32 = 300;

/// Largest number after `@` and after `+`; as a time, s, it is more than thirty years.
const LARGEST: f64 = 1e9;

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
    ("drifting-theta@S[:N]", "the arm's count gains 300 or N a second, |N| from 1 to 100000"),
    ("scaled-theta@F", "the arm's encoder gives F times as many counts"),
    ("flipped-theta", "the arm's encoder is wired in reverse"),
    ("flipped-alpha", "the pendulum's encoder is wired in reverse"),
    ("flipped-motor", "the motor is wired in reverse"),
    ("exchanged-encoders", "the encoders of arm and pendulum are exchanged"),
    ("dead-motor@S", "no current flows"),
    ("weak-motor@F", "only the fraction F of the current flows"),
    ("one-sided-motor@S:+|-", "only voltages of this sign drive"),
    ("stuck-output@S:V", "an armed board drives with V volts and ignores its acts"),
    ("ignored-disarm@S", "a disarm has no effect, and the board reports so"),
    ("blocked-arm@S", "something holds the arm"),
    ("pushed-arm@S+D:V", "a hand pushes the arm as V volts would"),
    ("held-pendulum@S+D", "a hand holds the pendulum"),
    ("amplifier@S[+D]", "the amplifier reports a fault [for D]"),
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
            Self::LapsingAmplifierFault { after_s, lasts_s } => {
                write!(formatter, "amplifier@{after_s}+{lasts_s}")
            }
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

/// The parts of a text form: NAME, NAME@S, NAME@S+D, NAME@S:N or NAME@S+D:V.
struct Parts<'a> {
    name: &'a str,
    /// The number after `@`, mostly a time in s.
    at: Option<f64>,
    /// The number after `+`, a duration in s.
    lasts_s: Option<f64>,
    /// The text after `:`.
    tail: Option<&'a str>,
}

impl<'a> Parts<'a> {
    /// Splits a text form; `None` if the number after `@` or `+` is invalid or out of range.
    fn of(text: &'a str) -> Option<Self> {
        let Some((name, values)) = text.split_once('@') else {
            return Some(Self { name: text, at: None, lasts_s: None, tail: None });
        };
        let (numbers, tail) = match values.split_once(':') {
            Some((numbers, tail)) => (numbers, Some(tail)),
            None => (values, None),
        };
        let (at, lasts_s) = match numbers.split_once('+') {
            Some((at, lasts)) => (at, Some(number(lasts, 0.0..=LARGEST)?)),
            None => (numbers, None),
        };
        Some(Self { name, at: Some(number(at, 0.0..=LARGEST)?), lasts_s, tail })
    }
}

/// Parses a number within these limits.
fn number(text: &str, limits: std::ops::RangeInclusive<f64>) -> Option<f64> {
    text.parse().ok().filter(|number| limits.contains(number))
}

/// The counts after `:`, or [`USUAL_COUNTS`] without a `:`.
fn counts(tail: Option<&str>) -> Option<i32> {
    tail.map_or(Some(USUAL_COUNTS), |counts| counts.parse().ok())
}

impl FromStr for EmulatorFault {
    type Err = UnknownFault;

    fn from_str(text: &str) -> Result<Self, UnknownFault> {
        Parts::of(text)
            .and_then(|parts| fault(&parts))
            .ok_or_else(|| UnknownFault { text: text.to_owned() })
    }
}

fn fault(parts: &Parts<'_>) -> Option<EmulatorFault> {
    use EmulatorFault as Fault;
    Some(match (parts.name, parts.at, parts.lasts_s, parts.tail) {
        ("wrong-version", None, None, None) => Fault::WrongVersion,
        ("flipped-theta", None, None, None) => Fault::FlippedTheta,
        ("flipped-alpha", None, None, None) => Fault::FlippedAlpha,
        ("flipped-motor", None, None, None) => Fault::FlippedMotor,
        ("exchanged-encoders", None, None, None) => Fault::ExchangedEncoders,
        ("garble", Some(every), None, None) if every >= 1.0 && every.fract() == 0.0 => {
            Fault::Garble { every: every as u32 }
        }
        ("weak-motor", Some(share), None, None) if share > 0.0 && share <= 1.0 => {
            Fault::WeakMotor { share }
        }
        ("scaled-theta", Some(factor), None, None) if factor > 0.0 && factor <= 10.0 => {
            Fault::ScaledTheta { factor }
        }
        ("silent", Some(after_s), None, None) => Fault::Silent { after_s },
        ("stuck-theta", Some(after_s), None, None) => Fault::StuckTheta { after_s },
        ("frozen-theta", Some(after_s), None, None) => Fault::FrozenTheta { after_s },
        ("frozen-theta", Some(after_s), Some(lasts_s), None) => {
            Fault::LapsingTheta { after_s, lasts_s }
        }
        ("frozen-alpha", Some(after_s), None, None) => Fault::FrozenAlpha { after_s },
        ("frozen-alpha", Some(after_s), Some(lasts_s), None) => {
            Fault::LapsingAlpha { after_s, lasts_s }
        }
        ("jump-theta", Some(after_s), None, tail) => {
            Fault::JumpTheta { after_s, counts: counts(tail)? }
        }
        ("jump-alpha", Some(after_s), None, tail) => {
            Fault::JumpAlpha { after_s, counts: counts(tail)? }
        }
        ("drifting-theta", Some(after_s), None, tail) => {
            let counts_s = counts(tail).filter(|it| (1..=100_000).contains(&it.unsigned_abs()))?;
            Fault::DriftingTheta { after_s, counts_s }
        }
        ("dead-motor", Some(after_s), None, None) => Fault::DeadMotor { after_s },
        ("blocked-arm", Some(after_s), None, None) => Fault::BlockedArm { after_s },
        ("one-sided-motor", Some(after_s), None, Some("+")) => {
            Fault::OneSidedMotor { after_s, positive: true }
        }
        ("one-sided-motor", Some(after_s), None, Some("-")) => {
            Fault::OneSidedMotor { after_s, positive: false }
        }
        ("stuck-output", Some(after_s), None, Some(volts)) => {
            Fault::StuckOutput { after_s, voltage_v: number(volts, -5.0..=5.0)? }
        }
        ("ignored-disarm", Some(after_s), None, None) => Fault::IgnoredDisarm { after_s },
        ("pushed-arm", Some(after_s), Some(lasts_s), Some(volts)) => {
            Fault::PushedArm { after_s, lasts_s, like_v: number(volts, f64::MIN..=f64::MAX)? }
        }
        ("held-pendulum", Some(after_s), Some(lasts_s), None) => {
            Fault::HeldPendulum { after_s, lasts_s }
        }
        ("amplifier", Some(after_s), None, None) => Fault::AmplifierFault { after_s },
        ("amplifier", Some(after_s), Some(lasts_s), None) => {
            Fault::LapsingAmplifierFault { after_s, lasts_s }
        }
        ("stall", Some(after_s), None, None) => Fault::StallError { after_s },
        ("qube-absent", Some(after_s), None, None) => Fault::QubeAbsent { after_s },
        ("qube-absent", Some(after_s), Some(off_s), None) => {
            Fault::SwitchedOffAndOn { after_s, off_s }
        }
        ("unplug", Some(after_s), None, None) => Fault::Unplugged { after_s },
        ("unplug", Some(after_s), Some(away_s), None) => Fault::Replugged { after_s, away_s },
        ("power-loss", Some(after_s), None, None) => Fault::PowerLoss { after_s },
        ("brown-out", Some(after_s), None, None) => Fault::BrownOut { after_s },
        ("board-restart", Some(after_s), None, None) => Fault::BoardRestart { after_s },
        ("emergency-stop", Some(after_s), None, None) => Fault::EmergencyStop { after_s },
        _ => return None,
    })
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
            "amplifier@3+0.004",
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
