//! The option `--live`: rollouts shown while they happen, to browsers, Foxglove and Lichtblick.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use super::exit::Failure;
use super::printable::print_message;
use super::stop::Stop;
use crate::experiment::ExperimentEvent;
use crate::live::{LiveError, LiveSettings, LiveStatus, LiveView};
use crate::recording::Viewer;
use crate::session::{Purpose, SessionEvent};

/// Usual port of Foxglove's protocol.
const PORT: u16 = 8765;

/// The arguments of commands that can be watched.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Watching")]
pub struct LiveArguments {
    /// Show the work while it happens: a page for browsers with a Stop button, and all channels for
    /// Foxglove and Lichtblick. ADDR is a port, an IP address or IP:PORT; other computers reach it
    /// only if ADDR is no loopback address [without ADDR: 127.0.0.1:8765]
    #[arg(
        long,
        value_name = "ADDR",
        num_args = 0..=1,
        default_missing_value = "127.0.0.1:8765",
        value_parser = address
    )]
    live: Option<SocketAddr>,

    /// Let web pages of this origin read the live view too, such as https://app.foxglove.dev; may
    /// be repeated
    #[arg(long, value_name = "ORIGIN", requires = "live", value_parser = origin)]
    live_origin: Vec<String>,
}

fn address(text: &str) -> Result<SocketAddr, String> {
    let here = IpAddr::V4(Ipv4Addr::LOCALHOST);
    let port = text.strip_prefix(':').unwrap_or(text).parse().map(|port| (here, port));
    let ip = text.parse().map(|ip: IpAddr| (ip, PORT));
    text.parse()
        .or_else(|_| port.map(SocketAddr::from))
        .or_else(|_| ip.map(SocketAddr::from))
        .map_err(|_| "give a port, an IP address, or IP:PORT, such as 0.0.0.0:8765".to_owned())
}

fn origin(text: &str) -> Result<String, String> {
    let is_origin = text.split_once("://").is_some_and(|(scheme, host)| {
        !scheme.is_empty() && !host.is_empty() && !host.contains(['/', ' '])
    });
    if is_origin {
        Ok(text.to_owned())
    } else {
        Err("give SCHEME://HOST[:PORT] without a path".to_owned())
    }
}

impl LiveArguments {
    /// Returns whether the option is given.
    pub fn is_asked(&self) -> bool {
        self.live.is_some()
    }

    /// Returns the arguments for the live view of rig number `rig`, from 1, of several. Each rig
    /// has its own port, counted up from the given one; with port 0 the system chooses each.
    ///
    /// # Errors
    /// The port would be larger than 65 535.
    pub fn of_rig(&self, rig: u32) -> Result<Self, Failure> {
        let mut one = self.clone();
        if let Some(address) = one.live.as_mut().filter(|address| address.port() != 0) {
            let port = u16::try_from(u32::from(address.port()) + rig - 1);
            let no_port = |_| Failure::usage("--live: give a smaller port: each rig needs its own");
            address.set_port(port.map_err(no_port)?);
        }
        Ok(one)
    }

    /// Serves the live view if `--live` is given, and prints its address.
    pub fn serve(&self, command: &str, stop: &Stop) -> Result<Live, Failure> {
        let Some(address) = self.live else { return Ok(Live::default()) };
        let settings = LiveSettings { address, origins: self.live_origin.clone() };
        let flag = Arc::clone(&stop.flag);
        let stopping = move |peer: SocketAddr| {
            if !flag.swap(true, Ordering::Relaxed) {
                print_message(&format!(
                    "stopping at the request of the live view at {}: the arm is braked and the state is kept",
                    peer.ip()
                ));
            }
        };
        let view = LiveView::serve(&settings, stopping).map_err(|error| match error {
            LiveError::Address { .. } => {
                Failure::usage(format!("--live {error}; give another address"))
            }
            LiveError::System(_) => Failure::failed(error),
        })?;
        print_message(&format!("live view: {}", view.url()));
        view.update_status(|status| {
            command.clone_into(&mut status.command);
            status.doing = "at the beginning".to_owned();
        });
        Ok(Live { view: Some(view), ..Live::default() })
    }
}

/// The live view of a command; without `--live` it is empty and shows nothing.
#[derive(Default)]
pub struct Live {
    view: Option<LiveView>,
    /// Numbers of the candidates that are excitations.
    excitations: Vec<u32>,
}

impl Live {
    /// Returns the viewer of rollouts for the page; `None` without a live view.
    pub fn viewer(&self) -> Option<Arc<dyn Viewer>> {
        self.view.as_ref().map(LiveView::viewer)
    }

    /// Address of the page; empty without a view.
    pub fn url(&self) -> String {
        self.view.as_ref().map(LiveView::url).unwrap_or_default()
    }

    /// Shows the present activity of the command in words.
    pub fn doing(&self, activity: &str) {
        self.change(|status| activity.clone_into(&mut status.doing));
    }

    /// Shows that rollout number `rollout`, from 0, begins, of `of` rollouts.
    pub fn rollout(&self, rollout: u32, of: u32) {
        self.change(|status| {
            status.doing = format!("rollout {} of {of}", rollout + 1);
            status.total = Some(of);
        });
    }

    /// Shows the return of a rollout if it is the best so far.
    pub fn returned(&self, return_: Option<f64>) {
        self.change(|status| better(status, return_));
    }

    /// Shows one event of a session. `left` is the time until the session's last candidate is
    /// trained, if it is known.
    pub fn update(&mut self, event: &SessionEvent, left: Option<Duration>) {
        let Some(view) = &self.view else { return };
        match event {
            SessionEvent::Proposed { candidate, purpose, counts } => {
                if *purpose == Purpose::Excitation {
                    self.excitations.push(*candidate);
                    return view.update_status(|status| {
                        "exciting the Qube to identify it".clone_into(&mut status.doing);
                    });
                }
                view.update_status(|status| {
                    status.candidate = Some(*candidate);
                    status.total = counts.total;
                    status.time_left_s = left.map(|left| left.as_secs_f64());
                    status.doing = match purpose {
                        Purpose::Verification => "verifying the recommendation".to_owned(),
                        Purpose::Incumbent => "verifying the best candidate's policy".to_owned(),
                        _ => format!("candidate {candidate}"),
                    };
                });
            }
            SessionEvent::Training { candidate, update, .. } => view.update_status(|status| {
                let (done, mean) = (update.update + 1, update.mean_return);
                status.time_left_s = left.map(|left| left.as_secs_f64());
                status.doing =
                    format!("training candidate {candidate}: update {done}, return {mean:.0}");
            }),
            SessionEvent::Trained { candidate, .. } => view.update_status(|status| {
                status.time_left_s = left.map(|left| left.as_secs_f64());
                status.doing = format!("candidate {candidate} is trained");
            }),
            SessionEvent::RolloutBegins { candidate, rollout, .. } => {
                let is_excitation = self.excitations.contains(candidate);
                view.update_status(|status| {
                    status.doing = format!("candidate {candidate}, rollout {rollout}");
                    if !is_excitation {
                        status.candidate = Some(*candidate);
                    }
                });
            }
            SessionEvent::Rollout { candidate, rollout, verdict, .. } => {
                view.update_status(|status| {
                    status.doing = format!("candidate {candidate}, rollout {rollout} has ended");
                    status.time_left_s = left.map(|left| left.as_secs_f64());
                    // An excitation is no attempt to balance.
                    if !self.excitations.contains(candidate) {
                        better(status, verdict.return_());
                    }
                })
            }
            SessionEvent::Connected { .. } => self.doing("connected; the arm is homed"),
            _ => {}
        }
    }

    /// Shows one event of an experiment.
    pub fn experiment(&self, event: &ExperimentEvent) {
        match event {
            ExperimentEvent::Search {
                name,
                progress: SessionEvent::Proposed { candidate, .. },
            } => {
                self.doing(&format!("{name}: candidate {candidate}"));
            }
            ExperimentEvent::Search {
                name,
                progress: SessionEvent::RolloutBegins { candidate, rollout, .. },
            } => {
                self.doing(&format!("{name}: candidate {candidate}, rollout {rollout}"));
            }
            ExperimentEvent::Search { progress: SessionEvent::Rollout { verdict, .. }, .. } => {
                self.returned(verdict.return_());
            }
            ExperimentEvent::Trained { recipe, policy, .. } => {
                self.doing(&format!("{recipe}: policy {policy} is trained"));
            }
            ExperimentEvent::Ran { recipe, policy, results, .. } => {
                self.doing(&format!("{recipe}: policy {policy} has run"));
                for result in *results {
                    self.returned(result.return_);
                }
            }
            _ => {}
        }
    }

    fn change(&self, change: impl FnOnce(&mut LiveStatus)) {
        if let Some(view) = &self.view {
            view.update_status(change);
        }
    }
}

fn better(status: &mut LiveStatus, return_: Option<f64>) {
    // `None` is less than any number.
    if status.best_return < return_ {
        status.best_return = return_;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_may_be_a_port_or_an_ip_address() {
        assert_eq!(address("9000").unwrap().to_string(), "127.0.0.1:9000");
        assert_eq!(address(":9000").unwrap().to_string(), "127.0.0.1:9000");
        assert_eq!(address("0.0.0.0").unwrap().to_string(), "0.0.0.0:8765");
        assert_eq!(address("[::1]:9000").unwrap().to_string(), "[::1]:9000");
        assert_eq!(address("::1").unwrap().to_string(), "[::1]:8765");
        for bad in ["localhost:9000", "70000", "", "127.0.0.1:x"] {
            assert!(address(bad).unwrap_err().contains("IP:PORT"), "{bad}");
        }
        assert!(origin("https://app.foxglove.dev").is_ok());
        for bad in ["app.foxglove.dev", "https://app.foxglove.dev/", "://x", "*"] {
            assert!(origin(bad).is_err(), "{bad}");
        }
    }
}
