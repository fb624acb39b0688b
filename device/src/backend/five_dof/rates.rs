//! Angular rates from coarsely quantised counts.
//!
//! At 10 mm/s an encoder of 2000 lines gives a new count every tenth of a second at the shoulder, so the difference
//! of two readings is zero or far too large. Adaptive windowing (Janabi-Sharifi, Hayward and Chen 2000, IEEE Trans.
//! Control Systems Technology 8) uses the longest window in which a line fits every count within one count: long at
//! low speed, short at high speed.

/// Length of the history: 32 ms at 1 kHz.
const WINDOW: usize = 32;

/// The rate of one angle.
#[derive(Debug, Clone)]
pub(super) struct Rate {
    /// The noise of a reading, rad: its step.
    step: f64,
    /// Times in s and angles in rad, the newest at `newest`.
    times: [f64; WINDOW],
    angles: [f64; WINDOW],
    newest: usize,
    len: usize,
}

impl Rate {
    /// For readings in steps of `step` rad.
    pub(super) fn new(step: f64) -> Self {
        Self {
            step: step.abs(),
            times: [0.0; WINDOW],
            angles: [0.0; WINDOW],
            newest: 0,
            len: 0,
        }
    }

    /// Clears the history: the next reading is unrelated to it.
    pub(super) fn clear(&mut self) {
        self.len = 0;
    }

    /// Adds a reading at `time` (s) and returns the rate, rad/s. A time that is not after the last one changes
    /// nothing.
    pub(super) fn read(&mut self, time: f64, angle: f64) -> f64 {
        if self.len == 0 || time > self.times[self.newest] {
            self.newest = (self.newest + 1) % WINDOW;
            self.times[self.newest] = time;
            self.angles[self.newest] = angle;
            self.len = (self.len + 1).min(WINDOW);
        }
        self.rate()
    }

    /// Reading `back` before the newest.
    fn at(&self, back: usize) -> (f64, f64) {
        let i = (self.newest + WINDOW - back) % WINDOW;
        (self.times[i], self.angles[i])
    }

    fn rate(&self) -> f64 {
        let (time, angle) = self.at(0);
        let mut rate = 0.0;
        for back in 1..self.len {
            let (from, start) = self.at(back);
            let slope = (angle - start) / (time - from);
            let explains = |k: usize| {
                let (t, a) = self.at(k);
                (angle - slope * (time - t) - a).abs() <= self.step
            };
            if !(1..back).all(explains) {
                break;
            }
            rate = slope;
        }
        rate
    }
}
