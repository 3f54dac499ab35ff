//! The live view of a program that is built without it: there is no such option, and nothing is watched.

use std::sync::Arc;

use super::exit::Failure;
use super::stop::Stop;
use crate::experiment::ExperimentEvent;
use crate::recording::Viewer;
use crate::session::SessionEvent;

/// No arguments.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct LiveArguments {}

impl LiveArguments {
    pub fn is_asked(&self) -> bool {
        false
    }

    pub fn serve(&self, _command: &str, _stop: &Stop) -> Result<Live, Failure> {
        Ok(Live::default())
    }
}

/// No live view.
#[derive(Default)]
pub struct Live {}

impl Live {
    pub fn viewer(&self) -> Option<Arc<dyn Viewer>> {
        None
    }

    pub fn rollout(&self, _rollout: u32, _of: u32) {}

    pub fn returned(&self, _return: Option<f64>) {}

    pub fn experiment(&self, _news: &ExperimentEvent) {}

    pub fn tell(&mut self, _news: &SessionEvent, _candidates: u32) {}
}
