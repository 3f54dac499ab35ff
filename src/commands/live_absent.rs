//! A replacement of the live view in a program that is built without it: the option `--live` is
//! refused, and the error says how to build the program with it. Types and functions that other
//! commands use have the same names as in `live.rs`.

use std::sync::Arc;
use std::time::Duration;

use super::exit::Failure;
use super::stop::Stop;
use crate::experiment::ExperimentEvent;
use crate::recording::Viewer;
use crate::session::SessionEvent;

/// The arguments of the live view, which are parsed and refused.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct LiveArguments {
    /// Ask for the live view
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = "", hide = true)]
    live: Option<String>,

    /// Ask for the live view for an origin
    #[arg(long, value_name = "ORIGIN", requires = "live", hide = true)]
    live_origin: Vec<String>,
}

impl LiveArguments {
    pub fn is_asked(&self) -> bool {
        self.live.is_some()
    }

    pub fn of_rig(&self, _rig: u32) -> Result<Self, Failure> {
        Ok(self.clone())
    }

    pub fn serve(&self, _command: &str, _stop: &Stop) -> Result<Live, Failure> {
        if self.is_asked() {
            return Err(Failure::usage(
                "--live: this program was built without the live view. Build it with `cargo build --release \
                 --features live`; the binaries and packages of a release have it",
            ));
        }
        Ok(Live::default())
    }
}

/// An empty live view, which ignores all events.
#[derive(Default)]
pub struct Live {}

impl Live {
    pub fn viewer(&self) -> Option<Arc<dyn Viewer>> {
        None
    }

    pub fn url(&self) -> String {
        String::new()
    }

    pub fn rollout(&self, _rollout: u32, _of: u32) {}

    pub fn returned(&self, _return: Option<f64>) {}

    pub fn experiment(&self, _event: &ExperimentEvent) {}

    pub fn update(&mut self, _event: &SessionEvent, _left: Option<Duration>) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_refusal_of_the_live_view_says_how_to_build_the_program_with_it() {
        let stop = Stop::default();
        assert!(LiveArguments::default().serve("run", &stop).is_ok());
        let asked = LiveArguments { live: Some(String::new()), live_origin: Vec::new() };
        let refused = asked.serve("run", &stop).err().unwrap();
        assert!(refused.is_usage());
        let message = refused.ended_by()["cause"].to_string();
        assert!(message.contains("--features live"), "{message}");
    }
}
