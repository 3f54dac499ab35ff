//! The extremes of a swing, and the motion of the arm that the pendulum's swing causes.

/// Largest motion of an arm without voltage that the pendulum's swing causes, rad for each rad of
/// the swing, with any signs of the encoders.
pub const RECOIL: f64 = 0.7;

/// Window for the extremes of a swing, ticks: 0.8 s, more than one period of the pendulum (0.59 s
/// on an arm at rest).
const SWING_TICKS: u32 = 80;

/// Extremes of the pendulum's or the arm's angle over consecutive windows, each longer than a
/// period of the pendulum.
#[derive(Clone, Copy, Debug, Default)]
pub struct Swing {
    ticks: u32,
    lowest_rad: f64,
    highest_rad: f64,
}

/// Extent of a swing over one window.
#[derive(Clone, Copy, Debug)]
pub struct SwingWindow {
    /// Middle of the swing, rad.
    pub middle_rad: f64,
    /// Distance between the two extremes, rad.
    pub width_rad: f64,
}

impl Swing {
    /// Takes the next angle, rad; returns the swing's extent at the end of each window.
    pub fn update(&mut self, angle_rad: f64) -> Option<SwingWindow> {
        if self.ticks == 0 {
            (self.lowest_rad, self.highest_rad) = (angle_rad, angle_rad);
        }
        self.lowest_rad = self.lowest_rad.min(angle_rad);
        self.highest_rad = self.highest_rad.max(angle_rad);
        self.ticks += 1;
        if self.ticks < SWING_TICKS {
            return None;
        }
        self.ticks = 0;
        Some(SwingWindow {
            middle_rad: 0.5 * (self.lowest_rad + self.highest_rad),
            width_rad: self.highest_rad - self.lowest_rad,
        })
    }
}
