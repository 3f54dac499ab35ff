//! Draws cells on a terminal with ANSI control sequences, which every terminal understands.

use std::fmt::Write as _;
use std::io;

use ratatui::backend::{Backend, ClearType, WindowSize};
use ratatui::buffer::Cell;
use ratatui::layout::{Position, Size};
use ratatui::style::{Color, Modifier};
use rustix::termios::tcgetwinsize;

use super::super::terminal;

/// A terminal that takes each frame in one write, so that a slow line does not show half of a frame
/// for long.
#[derive(Debug, Default)]
pub struct Ansi {
    frame: String,
    size: Size,
}

impl Ansi {
    /// Makes a terminal before its first frame; `size` is used while the terminal reports no size.
    pub fn new(size: Size) -> Self {
        Self { frame: String::new(), size }
    }
}

/// Returns the size of the terminal behind stdin, columns and rows; `None` if stdin is no terminal
/// or its size is not known.
pub fn size() -> Option<Size> {
    let found = tcgetwinsize(rustix::stdio::stdin()).ok()?;
    (found.ws_col > 0 && found.ws_row > 0).then(|| Size::new(found.ws_col, found.ws_row))
}

/// Returns the control sequence for the style of a cell. Six of the terminal's basic colours are
/// used; the user's theme defines their shades. Any other colour becomes the default one.
fn style(cell: &Cell) -> String {
    let mut codes = String::from("\x1b[0");
    for (modifier, code) in [
        (Modifier::BOLD, 1),
        (Modifier::DIM, 2),
        (Modifier::UNDERLINED, 4),
        (Modifier::REVERSED, 7),
    ] {
        if cell.modifier.contains(modifier) {
            let _ = write!(codes, ";{code}");
        }
    }
    let code = match cell.fg {
        Color::Red => 31,
        Color::Green => 32,
        Color::Yellow => 33,
        Color::Blue => 34,
        Color::Magenta => 35,
        Color::Cyan => 36,
        _ => 39,
    };
    let _ = write!(codes, ";{code}m");
    codes
}

impl Backend for Ansi {
    type Error = io::Error;

    fn draw<'a, I>(&mut self, content: I) -> io::Result<()>
    where
        I: Iterator<Item = (u16, u16, &'a Cell)>,
    {
        let mut next: Option<(u16, u16)> = None;
        let mut last = String::new();
        for (x, y, cell) in content {
            if next != Some((x, y)) {
                let _ = write!(self.frame, "\x1b[{};{}H", y + 1, x + 1);
            }
            let style = style(cell);
            if style != last {
                self.frame += &style;
                last = style;
            }
            self.frame += cell.symbol();
            next = Some((x + 1, y));
        }
        self.frame += "\x1b[0m";
        Ok(())
    }

    fn hide_cursor(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn show_cursor(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn get_cursor_position(&mut self) -> io::Result<Position> {
        Ok(Position::ORIGIN)
    }

    fn set_cursor_position<P: Into<Position>>(&mut self, position: P) -> io::Result<()> {
        let Position { x, y } = position.into();
        let _ = write!(self.frame, "\x1b[{};{}H", y + 1, x + 1);
        Ok(())
    }

    fn clear(&mut self) -> io::Result<()> {
        self.frame += "\x1b[0m\x1b[2J";
        Ok(())
    }

    fn clear_region(&mut self, _: ClearType) -> io::Result<()> {
        self.clear()
    }

    fn size(&self) -> io::Result<Size> {
        Ok(size().unwrap_or(self.size))
    }

    fn window_size(&mut self) -> io::Result<WindowSize> {
        Ok(WindowSize { columns_rows: self.size()?, pixels: Size::default() })
    }

    fn flush(&mut self) -> io::Result<()> {
        terminal::write_screen(self.frame.as_bytes());
        self.frame.clear();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_are_written_together_and_styles_only_where_they_change() {
        let mut terminal = Ansi::new(Size::new(10, 2));
        let mut red = Cell::new("a");
        red.fg = Color::Red;
        let plain = Cell::new("b");
        terminal
            .draw([(2, 1, &red), (3, 1, &red), (4, 1, &plain), (0, 0, &plain)].into_iter())
            .unwrap();
        let expected = "\x1b[2;3H\x1b[0;31maa\x1b[0;39mb\x1b[1;1Hb\x1b[0m";
        assert_eq!(terminal.frame, expected);
    }
}
