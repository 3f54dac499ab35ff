use std::io::Write;
use std::process::Command;
use std::time::{Duration, Instant};

use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::style::Color;

use super::draw::{Styles, draw};
use super::rollout::{RolloutPanel, RolloutState};
use super::state::{Overlay, Pause, ScreenState, Training};
use super::{Progress, ScreenArgument, pressed};
use crate::commands::output::Output;
use crate::commands::stop::Stop;
use crate::qube::State;
use crate::recording::Viewer;
use crate::safety::SafetyBox;
use crate::telemetry::{LatencySummary, Phase, TickRecord};

/// Longest wait of a test; a busy computer needs less.
const PATIENCE: Duration = Duration::from_secs(600);

fn drawn(size: (u16, u16), state: &ScreenState, rollout: &RolloutState, styles: Styles) -> Buffer {
    let mut terminal = Terminal::new(TestBackend::new(size.0, size.1)).unwrap();
    let now = state.began + Duration::from_secs(754);
    terminal.draw(|frame| draw(frame, state, rollout, now, styles)).unwrap();
    terminal.backend().buffer().clone()
}

/// Returns the letters of a screen, without the blanks at the ends of its rows.
fn text(buffer: &Buffer) -> String {
    let width = usize::from(buffer.area.width);
    let rows = buffer.content.chunks(width).map(|row| {
        let row: String = row.iter().map(|cell| cell.symbol()).collect();
        row.trim_end().to_owned() + "\n"
    });
    rows.collect()
}

/// Compares a screen with the file of this name in `snapshots/`.
#[track_caller]
fn is_as(name: &str, buffer: &Buffer) {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/commands/screen/snapshots");
    let expected = std::fs::read_to_string(format!("{folder}/{name}.txt")).unwrap();
    let found = text(buffer);
    assert!(found == expected, "{name}.txt:\n{expected}\nfound:\n{found}");
}

/// Returns a session in the training of its fourth candidate.
fn in_training() -> ScreenState {
    let began = Instant::now();
    let mut state = ScreenState::new("qube-hil session in logs/monday".into(), began);
    state.work = "candidate 3: proposed by the search, 4 of at most 11".into();
    state.phase = "training in simulation".into();
    state.done = Some((3, 11));
    state.may_end_early = true;
    state.ends = Some(began + Duration::from_secs(754 + 1000));
    state.best = "best so far: candidate 1 with a return of 512; 2 of 2 rollouts balance".into();
    for (number, grown) in [(0, 4.0), (1, 6.0)] {
        let returns = (0..70).map(|update| 20.0 + grown * f64::from(update)).collect();
        let name = format!("candidate 3, training {} of 2", number + 1);
        let began = began + Duration::from_secs(733);
        state
            .trainings
            .insert((String::new(), 3, number), Training { name, updates: 120, returns, began });
    }
    state.add_message("candidate 2, rollout 0: 488, balances");
    state.add_message(
        "warning: this thread has no right to real time (SCHED_FIFO): other programs can delay it. See docs/hardware.md",
    );
    state
}

/// Returns a rollout that has come close to a limit.
fn near_a_limit() -> RolloutState {
    let state = State { theta: -1.9, alpha: 3.1, theta_dot: 2.0, alpha_dot: -0.4 };
    let tick =
        TickRecord { phase: Phase::Running, state, voltage_mv: -2350, ..TickRecord::default() };
    RolloutState {
        name: Some("candidate 3".into()),
        rollout: 1,
        is_excitation: false,
        is_running: true,
        limits: Some(SafetyBox::GUARDED),
        largest_voltage_v: 5.0,
        tick,
        steps: 231,
        nearest: [0.83, 0.3, 0.41, 0.52],
        lateness_us: LatencySummary { p50: 5.0, p99: 31.0, p999: 60.0, max: 64.0 },
        ticks: 2345,
        missed: 1,
    }
}

#[test]
fn a_session_fits_on_24_rows_of_80_letters() {
    is_as("session", &drawn((80, 24), &in_training(), &RolloutState::default(), Styles::new(true)));
}

#[test]
fn a_rollout_shows_its_state_between_its_limits() {
    let mut state = in_training();
    state.trainings.clear();
    state.phase = "rollouts on the Qube".into();
    state.pause = Pause::Asked;
    state.live = "http://127.0.0.1:8765/".into();
    is_as("rollout", &drawn((80, 24), &state, &near_a_limit(), Styles::new(true)));
}

#[test]
fn a_rollout_has_the_name_of_its_policy_or_excitation() {
    for (name, is_excitation, title) in [
        (Some("robust 2"), false, "Rollout 1 of robust 2 "),
        (Some("excitation by chirp"), true, "Rollout 1: excitation by chirp "),
        (None, false, "Rollout 1 "),
    ] {
        let name = name.map(str::to_owned);
        let rollout = RolloutState { name, is_excitation, ..near_a_limit() };
        let shown = text(&drawn((80, 24), &in_training(), &rollout, Styles::new(true)));
        assert!(shown.contains(title), "{title:?} is missing:\n{shown}");
    }
}

#[test]
fn a_small_terminal_keeps_the_work_the_messages_and_the_keys() {
    is_as("small", &drawn((44, 12), &in_training(), &near_a_limit(), Styles::new(true)));
    // The screen can be drawn in every size.
    for (width, height) in [(1, 1), (3, 40), (200, 2), (59, 18), (60, 17), (10, 30), (300, 90)] {
        let mut state = in_training();
        for overlay in [Overlay::None, Overlay::Help, Overlay::Quit, Overlay::Question("?".into())]
        {
            state.overlay = overlay;
            drawn((width, height), &state, &near_a_limit(), Styles::new(true));
        }
    }
}

#[test]
fn the_help_explains_keys_and_symbols() {
    let mut state = in_training();
    state.overlay = Overlay::Help;
    is_as("help", &drawn((80, 24), &state, &RolloutState::default(), Styles::new(true)));
}

#[test]
fn no_colour_is_used_where_the_user_wants_none() {
    let coloured = |styles| {
        let buffer = drawn((80, 24), &in_training(), &near_a_limit(), styles);
        let is_coloured = |colour: Color| colour != Color::Reset;
        buffer.content.iter().any(|cell| is_coloured(cell.fg) || is_coloured(cell.bg))
    };
    assert!(coloured(Styles::new(true)));
    assert!(!coloured(Styles::new(false)));
}

#[test]
fn keys_stop_pause_ask_and_help() {
    let mut state = in_training();
    assert!(pressed(&mut state.clone(), b' '));
    assert!(!pressed(&mut state, b'p'));
    assert_eq!(state.pause, Pause::Asked);
    assert!(!pressed(&mut state, b'p'));
    assert_eq!(state.pause, Pause::No);
    for (key, overlay) in [(b'?', Overlay::Help), (b'q', Overlay::Quit)] {
        assert!(!pressed(&mut state, key));
        assert_eq!(state.overlay, overlay);
        // Another key closes the overlay and does nothing else.
        assert!(!pressed(&mut state, b'p'));
        assert_eq!((&state.overlay, state.pause), (&Overlay::None, Pause::No));
    }
    assert!(!pressed(&mut state, b'y'), "y stops without the question");
    assert!(!pressed(&mut state, b'q') && pressed(&mut state, b'y'));
    state.overlay = Overlay::Help;
    assert!(pressed(&mut state, b' '), "the space bar does not stop under the help");
    let mut training = ScreenState { can_pause: false, ..in_training() };
    assert!(!pressed(&mut training, b'p'));
    assert_eq!(training.pause, Pause::No);
}

#[test]
fn a_rollout_is_followed_tick_by_tick() {
    let view = RolloutPanel::default();
    assert_eq!(view.state().nearest_limit(), None);
    let header = crate::rig::RolloutPlan::single("run", "classical").header();
    view.begins(&header, 0);
    let limits = header.settings.safety_box;
    let tick = |number: u32, phase, part: f64| {
        let state = State { theta: -part * limits.theta, ..State::default() };
        TickRecord {
            tick: number,
            phase,
            state,
            lateness_ns: 5000,
            measurement: Some(crate::qube::Measurement::default()),
            ..TickRecord::default()
        }
    };
    // The ticks of settling count neither as steps nor for the limits: the policy does not control
    // them.
    view.ticked(&tick(0, Phase::Settling, 0.9));
    assert_eq!(view.state().nearest_limit(), None);
    view.ticked(&tick(1, Phase::Running, 0.5));
    view.ticked(&tick(2, Phase::Running, 0.25));
    view.ticked(&TickRecord {
        measurement: None,
        skipped_periods: 2,
        ..tick(3, Phase::Running, f64::NAN)
    });
    let state = view.state();
    assert_eq!(state.nearest_limit(), Some(("θ", 0.5)));
    assert_eq!((state.steps, state.ticks, state.missed), (3, 4, 3));
    assert_eq!(state.lateness_us.max, 5.0);
    view.ended(None);
    assert!(!view.state().is_running);
    // The next rollout begins anew, and the count of deadlines goes on.
    view.begins(&header, 0);
    let state = view.state();
    assert_eq!((state.steps, state.ticks, state.missed, state.nearest), (0, 4, 3, [0.0; 4]));
}

#[test]
fn progress_without_a_screen_waits_for_nothing() {
    let stop = std::sync::atomic::AtomicBool::new(false);
    Progress::lines().wait_while_paused(&stop);
    assert!(!Progress::lines().pressed(b' '));
}

/// Environment variable with the path of the file whose appearance ends the screen of
/// `panics_under_a_screen`.
const LOOKED: &str = "QUBE_HIL_TEST_SCREEN_LOOKED";

/// Opens a screen in the terminal that `a_panic_leaves_the_terminal_clean` gives it, and panics
/// once that test has looked at the screen.
#[test]
#[ignore = "run by a_panic_leaves_the_terminal_clean, in a terminal"]
fn panics_under_a_screen() {
    let (output, stop) = (Output::new(false), Stop::default());
    let screen = ScreenArgument { plain: false }.open("about to panic", &output, &stop);
    assert!(screen.progress().has_screen());
    screen.progress().line("said before");
    let looked = std::path::PathBuf::from(std::env::var_os(LOOKED).unwrap());
    let begun = Instant::now();
    while !looked.exists() {
        assert!(begun.elapsed() < PATIENCE, "the test has not looked at the screen");
        std::thread::sleep(Duration::from_millis(20));
    }
    panic!("this is the end");
}

#[test]
fn a_panic_leaves_the_terminal_clean() {
    if Command::new("tmux").arg("-V").output().is_err() {
        assert!(
            std::env::var_os("QUBE_HIL_REQUIRE_TMUX").is_none_or(|it| it.is_empty()),
            "tmux is not installed"
        );
        // Not with eprintln, whose text the test harness hides if the test passes.
        let _ =
            writeln!(std::io::stderr(), "\nSKIPPED: a test of the screen. tmux is not installed");
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let tmux = |arguments: &[&str]| {
        let mut command = Command::new("tmux");
        command.arg("-S").arg(directory.path().join("tmux")).args(["-f", "/dev/null"]);
        let output = command.args(arguments).env_remove("TMUX").output().unwrap();
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let program = std::env::current_exe().unwrap();
    let test = "commands::screen::tests::panics_under_a_screen --exact --ignored --nocapture";
    let looked = directory.path().join("looked");
    let variable = format!("{LOOKED}='{}'", looked.display());
    let line =
        format!("{variable} {} {test}; echo \"exit=\"$?; exec sleep 1000", program.display());
    tmux(&["new-session", "-d", "-x", "100", "-y", "40", "sh", "-c", &line]);
    let wait_for = |text: &str| {
        let begun = Instant::now();
        loop {
            let shown = tmux(&["capture-pane", "-p"]);
            if shown.contains(text) {
                return shown;
            }
            assert!(begun.elapsed() < PATIENCE, "{text} does not appear:\n{shown}");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    let terminal = || tmux(&["display-message", "-p", "#{alternate_on} #{cursor_flag}"]);
    wait_for("about to panic");
    let with_screen = terminal();
    std::fs::write(&looked, "").unwrap();
    let shown = wait_for("exit=101");
    let afterwards = terminal();
    tmux(&["kill-server"]);
    assert_eq!((with_screen.trim(), afterwards.trim()), ("1 0", "0 1"));
    // The messages, and the panic's own message, can still be read.
    assert!(shown.contains("said before") && shown.contains("this is the end"), "{shown}");
}
