//! The screen of long work at a terminal: phase, progress, training, rollout, messages, keys.
//!
//! A thread draws the screen five times a second from a state that the work updates. The control
//! thread takes no part: the recorder's thread passes ticks to a [`RolloutPanel`]. While the screen
//! has the terminal, every line that is written to stderr becomes a message on the screen; the
//! messages are printed on stderr when the screen is gone.

mod backend;
mod capture;
mod draw;
mod rollout;
mod state;
#[cfg(test)]
mod tests;

use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use ratatui::Terminal;
use rustix::stdio::{stderr, stdin};
use rustix::termios::isatty;

use self::backend::Ansi;
use self::capture::CapturedStderr;
use self::draw::{Styles, draw};
pub use self::rollout::RolloutPanel;
use self::state::{Overlay, Pause, STOP_EFFECT};
pub use self::state::{ScreenState, in_words, left_in_words, time_left};
use super::output::Output;
use super::printable::{print_message, printable};
use super::stop::Stop;
use super::terminal;
use crate::recording::Viewer;

/// Interval between frames.
const FRAME: Duration = Duration::from_millis(200);

/// Largest number of messages that a frame gets.
const SHOWN_MESSAGES: usize = 200;

/// The smallest terminal that has a screen, columns and rows; a smaller one gets lines.
const SMALLEST: (u16, u16) = (40, 10);

/// The argument that makes a long command write its progress as lines instead of showing a screen.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct ScreenArgument {
    /// Write progress as lines, without the screen that a terminal gets
    #[arg(long)]
    plain: bool,
}

/// The state that the threads of a screen share.
#[derive(Debug)]
pub struct Shared {
    state: Mutex<ScreenState>,
    rollout: Arc<RolloutPanel>,
    stop: Arc<AtomicBool>,
    ended: AtomicBool,
}

/// Progress of a long command: on the screen, or as lines on stderr.
#[derive(Clone, Debug)]
pub struct Progress {
    shared: Option<Arc<Shared>>,
}

/// The screen at a terminal, or no screen. Dropping it restores the terminal and prints the
/// messages on stderr.
#[derive(Debug)]
pub struct Screen {
    shared: Option<Arc<Shared>>,
    drawer: Option<JoinHandle<()>>,
    captured: Option<CapturedStderr>,
}

impl ScreenArgument {
    /// Opens the screen of a command if the user wants it, and stdin and stderr are a terminal in
    /// the foreground that can show it. Otherwise there is no screen, and progress is written as
    /// lines.
    pub fn open(self, title: &str, output: &Output, stop: &Stop) -> Screen {
        let is_dumb = std::env::var_os("TERM").is_none_or(|term| term.is_empty() || term == "dumb");
        let is_wanted = !self.plain && !output.is_for_scripts() && !is_dumb;
        let is_terminal = || isatty(stdin()) && isatty(stderr()) && terminal::is_foreground();
        if is_wanted && is_terminal() && is_large_enough() {
            Screen::shown(title, stop).unwrap_or_else(|_| Screen::none())
        } else {
            Screen::none()
        }
    }
}

fn is_large_enough() -> bool {
    backend::size().is_some_and(|size| size.width >= SMALLEST.0 && size.height >= SMALLEST.1)
}

impl Screen {
    /// Makes a screen that shows nothing.
    pub fn none() -> Self {
        Self { shared: None, drawer: None, captured: None }
    }

    fn shown(title: &str, stop: &Stop) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            state: Mutex::new(ScreenState::new(printable(title).into_owned(), Instant::now())),
            rollout: Arc::default(),
            stop: Arc::clone(&stop.flag),
            ended: AtomicBool::new(false),
        });
        let of_messages = Arc::clone(&shared);
        terminal::enter_screen()?;
        let captured =
            CapturedStderr::begin(move |line| of_messages.state().add_message(&printable(&line)));
        let captured = captured.inspect_err(|_| terminal::leave_screen())?;
        let mut screen =
            Self { shared: Some(Arc::clone(&shared)), drawer: None, captured: Some(captured) };
        let drawer = Builder::new().name("screen".into()).spawn(move || keep_drawing(&shared))?;
        screen.drawer = Some(drawer);
        Ok(screen)
    }

    /// Returns the progress that the screen shows.
    pub fn progress(&self) -> Progress {
        Progress { shared: self.shared.clone() }
    }

    /// Returns the viewer that shows rollouts on the screen; `None` without a screen.
    pub fn viewer(&self) -> Option<Arc<dyn Viewer>> {
        let shared = self.shared.as_ref()?;
        Some(Arc::clone(&shared.rollout) as Arc<dyn Viewer>)
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        let Some(shared) = self.shared.take() else { return };
        shared.ended.store(true, Ordering::Relaxed);
        if let Some(drawer) = self.drawer.take() {
            drawer.thread().unpark();
            let _ = drawer.join();
        }
        terminal::leave_screen();
        self.captured = None;
        let mut stderr = std::io::stderr().lock();
        for message in &shared.state().messages {
            // A terminal that is gone shows nothing. Nothing may panic here, because this may run
            // while a panic unwinds.
            let _ = writeln!(stderr, "{message}");
        }
    }
}

impl Progress {
    /// Makes a progress that is written as lines.
    #[cfg(test)]
    pub fn lines() -> Self {
        Self { shared: None }
    }

    /// Returns whether a screen shows this progress.
    pub fn has_screen(&self) -> bool {
        self.shared.is_some()
    }

    /// Shows one line of progress: as a message on the screen, or on stderr.
    pub fn line(&self, text: &str) {
        let text = printable(text);
        match &self.shared {
            Some(shared) => shared.state().add_message(&text),
            None => print_message(&text),
        }
    }

    /// Changes the state that the screen shows; does nothing without a screen.
    pub fn update(&self, change: impl FnOnce(&mut ScreenState)) {
        if let Some(shared) = &self.shared {
            change(&mut shared.state());
        }
    }

    /// Waits while the operator wants a pause; a request to stop ends the pause.
    pub fn wait_while_paused(&self, stop: &AtomicBool) {
        let Some(shared) = &self.shared else { return };
        loop {
            {
                let mut state = shared.state();
                if state.pause == Pause::No || stop.load(Ordering::Relaxed) {
                    state.pause = Pause::No;
                    return;
                }
                state.pause = Pause::Now;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Returns the effect of a stop on the present work, in words.
    pub fn stop_effect(&self) -> &'static str {
        self.shared.as_ref().map_or(STOP_EFFECT, |shared| shared.state().stop_effect)
    }

    /// Shows a question until [`Self::answered`].
    pub fn ask(&self, question: &str) {
        self.update(|state| state.overlay = Overlay::Question(printable(question).into_owned()));
    }

    /// Removes the question.
    pub fn answered(&self) {
        self.update(|state| state.overlay = Overlay::None);
    }

    /// Reacts to a key; returns whether the key requests a stop.
    pub fn pressed(&self, key: u8) -> bool {
        self.shared.as_ref().is_some_and(|shared| pressed(&mut shared.state(), key))
    }
}

/// Changes the state according to a key; returns whether the key requests a stop.
fn pressed(state: &mut ScreenState, key: u8) -> bool {
    let overlay = std::mem::take(&mut state.overlay);
    match (overlay, key) {
        (_, b' ') | (Overlay::Quit, b'y' | b'Y') => {
            return true;
        }
        // Any other key closes the help or the question whether to quit.
        (Overlay::Help | Overlay::Quit, _) => {}
        (_, b'?' | b'h') => state.overlay = Overlay::Help,
        (_, b'q' | b'Q') => state.overlay = Overlay::Quit,
        (_, b'p' | b'P') if state.can_pause => {
            state.pause = if state.pause == Pause::No { Pause::Asked } else { Pause::No };
        }
        (overlay, _) => state.overlay = overlay,
    }
    false
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, ScreenState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns a copy of the state for one frame, so that no lock is held while a slow terminal
    /// takes the frame.
    fn for_frame(&self) -> ScreenState {
        let mut state = self.state();
        let messages = std::mem::take(&mut state.messages);
        let mut for_frame = state.clone();
        let first = messages.len().saturating_sub(SHOWN_MESSAGES);
        for_frame.messages.extend(messages.iter().skip(first).cloned());
        state.messages = messages;
        for_frame.is_stopping = self.stop.load(Ordering::Relaxed);
        for_frame
    }
}

/// Draws frames until the screen ends.
fn keep_drawing(shared: &Shared) {
    let Some(size) = backend::size() else { return };
    let Ok(mut frames) = Terminal::new(Ansi::new(size)) else { return };
    // An empty value counts as unset: https://no-color.org
    let colours = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let styles = Styles::new(colours);
    while !shared.ended.load(Ordering::Relaxed) {
        if terminal::take_redraw() {
            let _ = frames.clear();
        }
        let state = shared.for_frame();
        let rollout = shared.rollout.state();
        let _ = frames.draw(|frame| draw(frame, &state, &rollout, Instant::now(), styles));
        std::thread::park_timeout(FRAME);
    }
}
