use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use thiserror::Error;

use super::Diagnosis;
use crate::clock::{Clock, PunctualClock};
use crate::device::{
    Device, DeviceError, HilAddress, HilError, HilLink, NotAnAddress, find_library,
};
use crate::preflight::measure_link;
use crate::telemetry::MeasuredLink;

const LIBRARY: &str = "panel library";

/// The step that installs the vendor's library.
const INSTALL: &str =
    "install the vendor's package quanser-sdk, or name its libhil.so in QUBE_HIL_LIBHIL";

/// The step for a card whose error names no step.
const CHECK_PLUG: &str = "check that it is plugged in";

/// The reason why a card's link could not be measured.
#[derive(Debug, Error)]
enum CardError {
    /// The text is no address of a card.
    #[error(transparent)]
    Address(#[from] NotAnAddress),
    /// The card or its library failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
}

/// Tests whether the vendor's library is here; if it is, greets and samples each of these cards.
pub(super) fn diagnose(cards: &[String], stop: &AtomicBool) -> Vec<Diagnosis> {
    let library = match find_library() {
        Ok(name) => Diagnosis::well(LIBRARY, format!("{name}, for a Qube with the USB panel")),
        Err(HilError::NoLibrary { .. }) if cards.is_empty() => {
            Diagnosis::well(LIBRARY, "not installed; only a Qube with the USB panel needs it")
        }
        Err(HilError::NoLibrary { tried }) => {
            Diagnosis::unfit(LIBRARY, format!("not here (tried {tried})"), INSTALL)
        }
        Err(HilError::NotLoaded { reason }) => {
            let value = format!("cannot be loaded: {reason}");
            match cards {
                [] => Diagnosis::advice(LIBRARY, value, INSTALL),
                _ => Diagnosis::unfit(LIBRARY, value, INSTALL),
            }
        }
        Err(HilError::NoFunction { library, function }) => {
            Diagnosis::unfit(LIBRARY, format!("{library} has no function {function}"), INSTALL)
        }
        Err(error) => Diagnosis::unfit(LIBRARY, error.to_string(), INSTALL),
    };
    let is_here = library.remedy.is_none();
    let each = cards.iter().filter(|_| is_here).map(|card| of_card(card, measured(card, stop)));
    std::iter::once(library).chain(each).collect()
}

fn of_card(card: &str, measured: Result<Option<MeasuredLink>, CardError>) -> Diagnosis {
    let name = format!("card {card}");
    match measured {
        Ok(Some(link)) => {
            let ms = |us: f64| us * 1e-3;
            let times = link.round_trip_us;
            let value = format!(
                "answers; a sample takes p50 {:.2}, p99 {:.2}, max {:.2} ms",
                ms(times.p50),
                ms(times.p99),
                ms(times.max)
            );
            Diagnosis::well(&name, value)
        }
        Ok(None) => Diagnosis::advice(&name, "not measured: stopped", "run the doctor again"),
        Err(CardError::Device(DeviceError::Hil(error))) => {
            Diagnosis::unfit(&name, error.cause(), error.remedy().unwrap_or(CHECK_PLUG))
        }
        Err(error) => Diagnosis::unfit(&name, error.to_string(), CHECK_PLUG),
    }
}

/// Measures the link to a card, whose amplifier stays off. `Ok(None)`: a stop was requested.
fn measured(card: &str, stop: &AtomicBool) -> Result<Option<MeasuredLink>, CardError> {
    let address: HilAddress = card.parse()?;
    let clock: Arc<dyn Clock> = Arc::new(PunctualClock::new());
    let mut link = HilLink::open(&address, Arc::clone(&clock))?;
    link.hello()?;
    Ok(measure_link(&mut link, &*clock, stop, card)?)
}

#[cfg(test)]
mod tests {
    use super::super::Suitability;
    use super::*;

    #[test]
    fn a_card_that_is_not_there_is_named_with_its_remedy() {
        let error = HilError::NoCard { port: "hil".into(), reason: "no. 1. board".into() };
        let failed = of_card("hil", Err(DeviceError::from(error).into()));
        assert_eq!(failed.verdict, Suitability::Unfit);
        assert_eq!(failed.value, "hil is not there: no. 1. board");
        assert!(failed.remedy.unwrap().starts_with("Switch the Qube on, plug its USB cable in"));
        let error = HilError::NoThread { port: "hil".into(), reason: "ended".into() };
        let failed = of_card("hil", Err(DeviceError::from(error).into()));
        assert_eq!(failed.remedy.unwrap(), CHECK_PLUG);
    }
}
