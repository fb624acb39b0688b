//! Signals of the boards: counts of the encoders, and codes for the converters that drive the motors.

/// An incremental encoder on a motor's shaft, read in quadrature: four counts per line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Encoder {
    /// Lines per turn.
    pub lines: u32,
    /// Turns of the motor per turn of the link; negative for the opposite direction.
    pub gear: f64,
}

impl Default for Encoder {
    /// Chiba Precision's ENC-258101 of the device of 2007: 2000 lines; directly on the link's axis.
    fn default() -> Self {
        Self {
            lines: 2000,
            gear: 1.0,
        }
    }
}

impl Encoder {
    /// Angle of the link between two counts, rad: 0.79 mrad for 2000 lines, 0.14 mm at the end of a 180 mm link.
    pub fn step_rad(&self) -> f64 {
        std::f64::consts::TAU / (4.0 * f64::from(self.lines) * self.gear)
    }

    /// The angle of a link (rad) at `count`, relative to the zero of its counter.
    pub fn angle(&self, count: i32) -> f64 {
        f64::from(count) * self.step_rad()
    }

    /// Count of a link at this angle (rad): the last line it has passed.
    pub fn count(&self, angle: f64) -> i32 {
        (angle / self.step_rad()).floor() as i32
    }
}

/// Conversion from a digital code to a torque of the link: converter, amplifier, motor and gear.
///
/// There is no default, because the limits of the motors of 2007 are unknown and a wrong one can be felt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive {
    /// Torque of the link per volt, N·m.
    pub torque_per_volt_nm: f64,
    /// The converter's range is from minus to plus this voltage.
    pub full_scale_v: f64,
    /// Width of the converter, 8 to 24.
    pub bits: u32,
    /// The largest torque, N·m; at most that of the full scale.
    pub limit_nm: f64,
}

impl Drive {
    fn code_max(&self) -> i32 {
        (1 << (self.bits - 1)) - 1
    }

    /// Torque between two codes, N·m.
    pub fn step_nm(&self) -> f64 {
        let codes = f64::from(1_i32 << (self.bits - 1));
        self.torque_per_volt_nm * self.full_scale_v / codes
    }

    /// The code for a torque (N·m) of a link, clamped to the limit; zero for NaN.
    pub fn code(&self, nm: f64) -> i32 {
        let within = if nm.is_nan() {
            0.0
        } else {
            nm.clamp(-self.limit_nm, self.limit_nm)
        };
        // Rounded towards zero, so that no code exceeds the requested torque.
        (within / self.step_nm()) as i32
    }

    /// The torque (N·m) of a link for a code.
    pub fn torque(&self, code: i32) -> f64 {
        f64::from(code.clamp(-self.code_max(), self.code_max())) * self.step_nm()
    }
}
