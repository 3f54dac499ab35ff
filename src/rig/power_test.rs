use serde::{Deserialize, Serialize};

use super::file_date::date;

/// The result of a power test, as `[power]` in `qube.toml` contains it: the motor's behaviour when
/// the operator pulled the board's USB plug.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PowerTest {
    /// Behaviour of the motor.
    pub usb_lost: UsbLost,
    /// Date of the test, as year-month-day.
    #[serde(deserialize_with = "date")]
    pub date: String,
    /// Serial number of the board in the test.
    pub board: String,
}

/// The motor's behaviour when the board loses its USB power.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum UsbLost {
    /// The Qube switches the motor off.
    #[serde(rename = "motor off")]
    MotorOff,
    /// The motor keeps its last voltage.
    #[serde(rename = "motor keeps its voltage", alias = "motor keeps its word")]
    KeepsVoltage,
    /// The operator could not tell.
    #[serde(rename = "unknown")]
    Unknown,
}

impl PowerTest {
    /// The result of the test as a sentence for people.
    #[must_use]
    pub fn sentence(&self) -> &'static str {
        match self.usb_lost {
            UsbLost::MotorOff => "Without its board the motor of this Qube goes off.",
            UsbLost::KeepsVoltage => {
                "Without its board the motor of this Qube keeps its last voltage: only the Qube's own \
                 switch stops it."
            }
            UsbLost::Unknown => {
                "It is still not known how the motor of this Qube behaves without its board."
            }
        }
    }
}

/// The reason for a warning before a real Qube is driven.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PowerWarning {
    /// The motor keeps its last voltage when the board loses power.
    KeepsVoltage,
    /// The motor's behaviour when the board loses power is unknown.
    Unknown,
}

/// The warning that the result of a Qube's power test requires; `None` if the motor is known to go
/// off without its board.
#[must_use]
pub fn power_warning(power: Option<&PowerTest>) -> Option<PowerWarning> {
    match power.map(|power| power.usb_lost) {
        Some(UsbLost::MotorOff) => None,
        Some(UsbLost::KeepsVoltage) => Some(PowerWarning::KeepsVoltage),
        Some(UsbLost::Unknown) | None => Some(PowerWarning::Unknown),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_motor_that_is_known_to_go_off_needs_no_warning() {
        let known = |usb_lost| {
            let (date, board) = ("2026-01-31".to_owned(), "0123456789abcdef".to_owned());
            power_warning(Some(&PowerTest { usb_lost, date, board }))
        };
        assert_eq!(known(UsbLost::MotorOff), None);
        assert_eq!(known(UsbLost::KeepsVoltage), Some(PowerWarning::KeepsVoltage));
        assert_eq!(known(UsbLost::Unknown), Some(PowerWarning::Unknown));
        assert_eq!(power_warning(None), Some(PowerWarning::Unknown));
    }

    #[test]
    fn a_result_is_read_in_its_earlier_words_too() {
        for words in ["motor keeps its voltage", "motor keeps its word"] {
            let read: UsbLost = serde_json::from_str(&format!("{words:?}")).unwrap();
            assert_eq!(read, UsbLost::KeepsVoltage);
        }
        let written = serde_json::to_string(&UsbLost::KeepsVoltage).unwrap();
        assert_eq!(written, "\"motor keeps its voltage\"");
    }
}
