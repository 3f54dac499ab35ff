//! Draws the screen.

use std::time::Instant;

use ratatui::Frame;
use ratatui::layout::{Alignment, Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Borders, Clear, Gauge, Padding, Paragraph, Sparkline, Wrap};

use super::rollout::RolloutState;
use super::state::{Overlay, Pause, ScreenState, Training, in_words};
use crate::qube::MAX_STEPS;
use crate::telemetry::Phase;

/// The largest possible return: each step earns at most 1.
const LARGEST_RETURN: f64 = MAX_STEPS as f64;

/// Fraction of a limit above which a quantity is highlighted.
const NEAR: f64 = 0.8;

/// Rows of the middle, which shows trainings and the rollout.
const MIDDLE_ROWS: u16 = 8;
/// Smallest height of a screen that has the middle, rows.
const MIDDLE_FROM: u16 = 18;

/// The styles of the screen's texts, without colours where the user wants none.
#[derive(Clone, Copy, Debug)]
pub struct Styles {
    colours: bool,
}

impl Styles {
    /// Makes styles with or without colours.
    pub fn new(colours: bool) -> Self {
        Self { colours }
    }

    fn colour(self, colour: Color) -> Style {
        if self.colours { Style::new().fg(colour) } else { Style::new() }
    }

    fn title(self) -> Style {
        self.colour(Color::Cyan).add_modifier(Modifier::BOLD)
    }

    fn strong(self) -> Style {
        Style::new().add_modifier(Modifier::BOLD)
    }

    fn near(self) -> Style {
        self.colour(Color::Yellow).add_modifier(Modifier::BOLD)
    }

    fn alarm(self) -> Style {
        self.colour(Color::Red).add_modifier(Modifier::BOLD)
    }
}

/// Draws one frame: the state of the work and of the rollout at the time `now`.
pub fn draw(
    frame: &mut Frame,
    state: &ScreenState,
    rollout: &RolloutState,
    now: Instant,
    styles: Styles,
) {
    let area = frame.area();
    let has_middle = area.height >= MIDDLE_FROM;
    let rows = [
        Constraint::Length(1),
        Constraint::Length(5),
        Constraint::Length(if has_middle { MIDDLE_ROWS } else { 0 }),
        Constraint::Min(0),
        Constraint::Length(1),
    ];
    let [head, now_at, middle, messages, keys] = Layout::vertical(rows).areas(area);
    draw_head(frame, head, state, now, styles);
    draw_work(frame, now_at, state, rollout.is_running, now, styles);
    if has_middle {
        draw_middle(frame, middle, state, rollout, now, styles);
    }
    draw_messages(frame, messages, state, styles);
    draw_keys(frame, keys, state, styles);
    match &state.overlay {
        Overlay::None => {}
        Overlay::Help => draw_box(frame, "Help", &help(state), styles),
        Overlay::Quit => {
            let text = format!(
                "Stop now and quit? {}.\n\ny, space  yes     other keys  continue",
                capital(state.stop_effect)
            );
            draw_box(frame, "Quit", &text, styles);
        }
        Overlay::Question(text) => draw_box(frame, "The Qube needs you", text, styles),
    }
}

fn panel(title: &str, styles: Styles) -> Block<'_> {
    Block::new()
        .borders(Borders::TOP)
        .border_style(Style::new().add_modifier(Modifier::DIM))
        .title(Span::styled(format!(" {title} "), styles.title()))
        .padding(Padding::horizontal(1))
}

fn draw_head(frame: &mut Frame, area: Rect, state: &ScreenState, now: Instant, styles: Styles) {
    let elapsed = format!(" {} ", in_words(now.saturating_duration_since(state.began)));
    let width = u16::try_from(elapsed.len()).unwrap_or(0);
    let [title, time] =
        Layout::horizontal([Constraint::Min(0), Constraint::Length(width)]).areas(area);
    frame.render_widget(Line::styled(format!(" {}", state.title), styles.strong()), title);
    frame.render_widget(Line::from(elapsed).alignment(Alignment::Right), time);
}

fn draw_work(
    frame: &mut Frame,
    area: Rect,
    state: &ScreenState,
    is_running: bool,
    now: Instant,
    styles: Styles,
) {
    let mut block = panel("Work", styles);
    if !state.live.is_empty() && state.live.chars().count() + 20 < usize::from(area.width) {
        let live = Line::from(format!(" live view: {} ", state.live));
        block = block.title(live.alignment(Alignment::Right));
    }
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let [work, phase, progress, best] = Layout::vertical([Constraint::Length(1); 4]).areas(inner);
    frame.render_widget(Line::from(state.work.as_str()), work);
    let phase_line = match (state.is_stopping, state.pause) {
        (true, _) => Line::styled(format!("stopping: {}", state.stop_effect), styles.alarm()),
        (_, Pause::Now) => Line::styled("paused: the motor is off; p continues", styles.near()),
        (_, Pause::Asked) => {
            let which = if is_running { "this" } else { "the next" };
            let line = format!("{}; a pause follows {which} rollout", state.phase);
            Line::styled(line, styles.near())
        }
        _ => Line::styled(state.phase.as_str(), styles.strong()),
    };
    frame.render_widget(phase_line, phase);
    if let Some((done, all)) = state.done {
        let (words, room) = if area.width < 60 { ("", 40) } else { (" done", 43) };
        let [bar, caption] =
            Layout::horizontal([Constraint::Fill(1), Constraint::Length(room)]).areas(progress);
        let part = (done as f64 / all.max(1) as f64).clamp(0.0, 1.0);
        let style = styles.colour(Color::Cyan);
        frame.render_widget(
            Gauge::default().ratio(part).label("").gauge_style(style).use_unicode(true),
            bar,
        );
        let most = if state.may_end_early { "at most " } else { "" };
        let left = match state.ends {
            Some(ends) => format!("; {most}{} left", in_words(ends.saturating_duration_since(now))),
            None => String::new(),
        };
        frame.render_widget(Line::from(format!("  {done} of {most}{all}{words}{left}")), caption);
    }
    frame.render_widget(Line::from(state.best.as_str()), best);
}

fn draw_middle(
    frame: &mut Frame,
    area: Rect,
    state: &ScreenState,
    rollout: &RolloutState,
    now: Instant,
    styles: Styles,
) {
    // A narrow terminal has room for either the trainings or the rollout.
    let is_narrow = area.width < 60;
    if !state.has_rollouts || (is_narrow && state.has_trainings && !rollout.is_running) {
        return draw_trainings(frame, area, state, now, styles);
    }
    if is_narrow || !state.has_trainings {
        return draw_rollout(frame, area, rollout, styles);
    }
    let [left, right] =
        Layout::horizontal([Constraint::Fill(1), Constraint::Fill(1)]).spacing(1).areas(area);
    draw_trainings(frame, left, state, now, styles);
    draw_rollout(frame, right, rollout, styles);
}

fn draw_trainings(
    frame: &mut Frame,
    area: Rect,
    state: &ScreenState,
    now: Instant,
    styles: Styles,
) {
    let block = panel("Training: return (at most 600)", styles);
    let inner = block.inner(area);
    frame.render_widget(block, area);
    if state.trainings.is_empty() {
        frame.render_widget(
            Line::styled("no training at present", Style::new().add_modifier(Modifier::DIM)),
            inner,
        );
        return;
    }
    // Only the last trainings, in the order of their keys, fit; each has a curve and two lines of
    // text.
    let shown = usize::from(inner.height / 3).clamp(1, state.trainings.len());
    let parts = vec![Constraint::Fill(1); shown];
    let areas = Layout::vertical(parts).split(inner);
    let hidden = state.trainings.len() - shown;
    for (training, &area) in state.trainings.values().skip(hidden).zip(areas.iter()) {
        draw_training(frame, area, training, now, styles);
    }
}

fn draw_training(frame: &mut Frame, area: Rect, training: &Training, now: Instant, styles: Styles) {
    let rows = [Constraint::Min(1), Constraint::Length(1), Constraint::Length(1)];
    let [curve, name, numbers] = Layout::vertical(rows).areas(area);
    let data = columns(training, usize::from(curve.width));
    let style = styles.colour(Color::Green);
    frame.render_widget(
        Sparkline::default().data(data).max(LARGEST_RETURN as u64).style(style),
        curve,
    );
    frame.render_widget(Line::from(training.name.as_str()), name);
    let (done, all) = (training.returns.len(), training.updates);
    let best = training.best().unwrap_or_default();
    let left =
        training.left(now).map_or(String::new(), |left| format!(", {} left", in_words(left)));
    frame.render_widget(Line::from(format!("update {done}/{all}, best {best:.0}{left}")), numbers);
}

/// Returns the curve of the whole training in at most `width` columns: each column has the best
/// return of its updates, at least 0, and 0 before any of them is done.
fn columns(training: &Training, width: usize) -> Vec<u64> {
    let updates = training.updates.max(1) as usize;
    // A training with fewer updates than columns has one column for each update.
    let width = width.min(updates);
    let mut columns = vec![0; width];
    for (update, mean_return) in training.returns.iter().enumerate() {
        if let Some(column) = columns.get_mut(update * width / updates) {
            *column = (*column).max(mean_return.max(0.0) as u64);
        }
    }
    columns
}

fn draw_rollout(frame: &mut Frame, area: Rect, rollout: &RolloutState, styles: Styles) {
    let title = match (&rollout.limits, &rollout.name) {
        (None, _) => "Rollout".to_owned(),
        (Some(_), Some(name)) if rollout.is_excitation => {
            format!("Rollout {}: {name}", rollout.rollout)
        }
        (Some(_), Some(name)) => format!("Rollout {} of {name}", rollout.rollout),
        (Some(_), None) => format!("Rollout {}", rollout.rollout),
    };
    let block = panel(&title, styles);
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let Some(limits) = &rollout.limits else {
        frame.render_widget(
            Line::styled("none so far", Style::new().add_modifier(Modifier::DIM)),
            inner,
        );
        return;
    };
    let width = usize::from(inner.width);
    let phase = match (rollout.is_running, rollout.tick.phase) {
        (false, _) => "ended".to_owned(),
        (true, Phase::Settling) => "settling: the arm moves to its start".to_owned(),
        (true, Phase::Running) if rollout.is_excitation => {
            "the excitation has the motor".to_owned()
        }
        (true, Phase::Running) => "the policy has the motor".to_owned(),
        (true, Phase::Braking) => "braking".to_owned(),
    };
    // A step lasts 10 ms.
    let seconds = f64::from(rollout.steps) * 0.01;
    let state = &rollout.tick.state;
    let voltage_v = rollout.tick.voltage_v();
    let lines = [
        Line::styled(format!("{phase}, {seconds:.1} s"), styles.strong()),
        quantity(
            "θ",
            state.theta.to_degrees(),
            "°",
            limits.theta.to_degrees(),
            rollout.nearest[0],
            width,
            styles,
        ),
        quantity(
            "α",
            state.alpha.to_degrees(),
            "°",
            limits.alpha.to_degrees(),
            rollout.nearest[1],
            width,
            styles,
        ),
        quantity("V", voltage_v, "V", rollout.largest_voltage_v, 0.0, width, styles),
        match rollout.nearest_limit() {
            Some((name, part)) => {
                let style = if part > NEAR { styles.near() } else { Style::new() };
                Line::styled(format!("nearest to a limit: {name}, {:.0} %", 100.0 * part), style)
            }
            None => Line::default(),
        },
        {
            let missed = rollout.missed;
            let style = if missed > 0 { styles.near() } else { Style::new() };
            Line::styled(format!("deadlines: {missed} of {} missed", rollout.ticks), style)
        },
        Line::from(format!(
            "ticks late: p99 {:.0} µs, most {:.0} µs",
            rollout.lateness_us.p99, rollout.lateness_us.max
        )),
    ];
    frame.render_widget(Paragraph::new(lines.to_vec()), inner);
}

/// Returns a line with a quantity as a number and as a mark on a scale from -`limit` to `limit`.
/// `used` is the largest fraction of the limit that was reached so far; 0 shows no range. `width`
/// is the width of the line, in characters.
fn quantity<'a>(
    name: &'a str,
    value: f64,
    unit: &'a str,
    limit: f64,
    used: f64,
    width: usize,
    styles: Styles,
) -> Line<'a> {
    let number = format!("{name} {value:7.1} {unit:1} ");
    let style = if (value / limit).abs() > NEAR { styles.near() } else { Style::new() };
    let bar = scale(value / limit, used, width.saturating_sub(number.chars().count() + 2));
    Line::from(vec![Span::styled(number, style), Span::raw(format!("├{bar}┤"))])
}

/// Returns a scale from -1 to 1 in `width` characters, with a mark at `value` (at an end if `value`
/// lies beyond it, none if it is not finite) and a thick line from -`used` to `used`; empty if
/// `width` is less than 3.
fn scale(value: f64, used: f64, width: usize) -> String {
    if width < 3 {
        return String::new();
    }
    let last = (width - 1) as f64;
    let column = |part: f64| (((part.clamp(-1.0, 1.0) + 1.0) / 2.0) * last).round() as usize;
    let (low, high) = (column(-used), column(used));
    let mut marks: Vec<char> = (0..width)
        .map(|at| if used > 0.0 && (low..=high).contains(&at) { '━' } else { '─' })
        .collect();
    marks[column(0.0)] = '┼';
    if value.is_finite() {
        marks[column(value)] = '●';
    }
    marks.into_iter().collect()
}

fn draw_messages(frame: &mut Frame, area: Rect, state: &ScreenState, styles: Styles) {
    if area.height < 2 {
        return;
    }
    let block = panel("Messages", styles);
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let (width, height) = (usize::from(inner.width).max(1), usize::from(inner.height));
    let mut rows: Vec<Line> = Vec::new();
    for message in state.messages.iter().rev() {
        let wrapped = wrapped(message, width);
        for row in wrapped.into_iter().rev() {
            rows.push(Line::from(row));
        }
        if rows.len() >= height {
            break;
        }
    }
    rows.truncate(height);
    rows.reverse();
    frame.render_widget(Paragraph::new(rows), inner);
}

/// Returns a message in rows of at most `width` characters, broken between words. The rows after
/// the first are indented by two blanks. A word that does not fit into a row has a row of its own,
/// which is cut off at the screen's edge.
fn wrapped(message: &str, width: usize) -> Vec<String> {
    let mut rows = vec![String::new()];
    for word in message.split(' ') {
        let room = rows.last().map_or(0, |row| width.saturating_sub(row.chars().count()));
        let length = word.chars().count();
        match rows.last_mut() {
            Some(row) if row.is_empty() => row.push_str(word),
            Some(row) if length < room => {
                row.push(' ');
                row.push_str(word);
            }
            _ => rows.push(format!("  {word}")),
        }
    }
    rows
}

fn draw_keys(frame: &mut Frame, area: Rect, state: &ScreenState, styles: Styles) {
    let pause = match (state.can_pause, state.pause) {
        (false, _) => None,
        (true, Pause::No) if area.width < 60 => Some(("p", "pause")),
        (true, Pause::No) => Some(("p", "pause after this rollout")),
        (true, Pause::Asked) => Some(("p", "no pause")),
        (true, Pause::Now) => Some(("p", "continue")),
    };
    let keys = [Some(("space", "stop now")), pause, Some(("q", "quit")), Some(("?", "help"))];
    let mut spans = vec![Span::raw(" ")];
    for (key, meaning) in keys.into_iter().flatten() {
        spans.push(Span::styled(key, styles.title()));
        spans.push(Span::raw(format!(" {meaning}   ")));
    }
    frame.render_widget(Line::from(spans), area);
}

fn help(state: &ScreenState) -> String {
    let mut text = format!("space  stop now: {}\n", state.stop_effect);
    if state.can_pause {
        text += "p      pause after this rollout; p again continues\n";
    }
    text += "q      quit, after a question\n?      this help; any key closes it\n";
    text += "Ctrl-C like the space bar; twice: end at once\n\n";
    if state.has_rollouts {
        text +=
            "θ arm, α pendulum (0 hangs, ±180 is upright), V voltage; ━ is the range used so far. ";
    }
    text += "A return is at most 600. Messages are printed again at the end; --plain writes lines instead of this screen.";
    text
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// Draws a text in a box in the middle of the screen.
fn draw_box(frame: &mut Frame, title: &str, text: &str, styles: Styles) {
    let area = frame.area();
    let width = area.width.min(66);
    let paragraph = Paragraph::new(text).wrap(Wrap { trim: false });
    let inside = usize::from(width.saturating_sub(4)).max(1);
    let rows: usize = text.lines().map(|line| line.chars().count() / inside + 1).sum();
    let height = area.height.min(u16::try_from(rows + 2).unwrap_or(u16::MAX));
    let place = Rect {
        x: area.x + (area.width - width) / 2,
        y: area.y + (area.height - height) / 2,
        width,
        height,
    };
    let block = Block::bordered()
        .title(Span::styled(format!(" {title} "), styles.title()))
        .padding(Padding::horizontal(1));
    frame.render_widget(Clear, place);
    frame.render_widget(paragraph.block(block), place);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scale_marks_the_value_and_the_part_that_was_used() {
        assert_eq!(scale(0.0, 0.0, 9), "────●────");
        assert_eq!(scale(1.0, 0.0, 9), "────┼───●");
        assert_eq!(scale(-9.0, 1.0, 9), "●━━━┼━━━━");
        assert_eq!(scale(0.25, 0.5, 9), "──━━┼●━──");
        assert_eq!(scale(f64::NAN, 0.0, 9), "────┼────");
        assert_eq!(scale(0.0, 0.0, 2), "");
    }

    #[test]
    fn a_curve_covers_the_whole_training() {
        let training = |updates, returns: &[f64]| Training {
            name: "t".into(),
            updates,
            returns: returns.into(),
            began: Instant::now(),
        };
        assert_eq!(columns(&training(4, &[1.0, -5.0]), 10), [1, 0, 0, 0]);
        assert_eq!(columns(&training(8, &[1.0, 7.0, 3.0, 2.0, 9.0]), 4), [7, 3, 9, 0]);
        assert!(columns(&training(8, &[f64::NAN; 20]), 4).iter().all(|it| *it == 0));
    }

    #[test]
    fn long_messages_go_on_in_the_next_row() {
        assert_eq!(wrapped("one two three", 8), ["one two", "  three"]);
        assert_eq!(wrapped("", 8), [""]);
    }
}
