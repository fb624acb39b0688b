//! From mm of a drawing to pixels.

use super::section::Point;

/// Margin between drawing and frame, relative to the drawing.
const MARGIN: f64 = 0.03;

/// From mm of a drawing to pixels of a sheet.
pub(super) struct Frame {
    /// Pixels per mm.
    pub(super) scale: f64,
    /// Pixels of the frame.
    pub(super) size: [f32; 2],
    /// Its upper left corner, in pixels.
    pub(super) corner: [f32; 2],
    /// Coordinates of the frame's lower left corner, in mm.
    pub(super) origin: Point,
}

impl Frame {
    /// The largest frame around a drawing that fits into `room`.
    pub(super) fn around([low, high]: [Point; 2], room: [f32; 2], corner: [f32; 2]) -> Self {
        let margin = MARGIN * (high[0] - low[0]).max(high[1] - low[1]);
        let extent = [0, 1].map(|a| (high[a] - low[a] + 2.0 * margin).max(f64::MIN_POSITIVE));
        let scale = (f64::from(room[0]) / extent[0]).min(f64::from(room[1]) / extent[1]);
        Self {
            scale,
            size: extent.map(|e| (e * scale).ceil() as f32),
            corner,
            origin: low.map(|v| v - margin),
        }
    }

    pub(super) fn at(&self, p: Point) -> [f32; 2] {
        let [x, y] = [0, 1].map(|a| ((p[a] - self.origin[a]) * self.scale) as f32);
        [self.corner[0] + x, self.corner[1] + self.size[1] - y]
    }
}

/// The smallest round number (1, 2 or 5 times a power of ten) above a length.
pub(super) fn round_length(at_least: f64) -> f64 {
    let power = 10_f64.powf(at_least.max(f64::MIN_POSITIVE).log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|m| m * power);
    steps
        .into_iter()
        .find(|s| *s >= at_least)
        .unwrap_or(steps[3])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_lengths_are_one_two_or_five_times_a_power_of_ten() {
        for (at_least, round) in [
            (0.9, 1.0),
            (1.1, 2.0),
            (37.0, 50.0),
            (0.013, 0.02),
            (5.0, 5.0),
        ] {
            assert!(
                (round_length(at_least) - round).abs() < 1e-12 * round,
                "{at_least}"
            );
        }
    }
}
