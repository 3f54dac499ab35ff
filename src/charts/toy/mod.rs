//! The thesis's pictures of its toy problem, which explain the surrogate and the acquisition
//! functions.

mod figure_3_1;
mod figure_3_2;
mod posterior_panel;
mod problem;

pub use figure_3_1::{SAMPLES, draw as figure_3_1_svg};
pub use figure_3_2::draw as figure_3_2_svg;
