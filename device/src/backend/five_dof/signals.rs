//! Signals of the boards: counts of the encoders, and codes for the converters that drive the motors.

use thiserror::Error;

/// An incremental encoder on a motor's shaft, read in quadrature: four counts per line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Encoder {
    lines: u32,
    gear: f64,
}

/// Invalid parameters of an encoder.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[error("invalid encoder: {lines} lines, gear {gear}; both must be non-zero, and the gear finite")]
pub struct BadEncoder {
    lines: u32,
    gear: f64,
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
    /// An encoder of so many lines per turn, whose motor turns `gear` times per turn of the link; below zero, the
    /// other way round.
    pub fn new(lines: u32, gear: f64) -> Result<Self, BadEncoder> {
        if lines > 0 && gear != 0.0 && gear.is_finite() {
            Ok(Self { lines, gear })
        } else {
            Err(BadEncoder { lines, gear })
        }
    }

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
    torque_per_volt_nm: f64,
    full_scale_v: f64,
    bits: u32,
    limit_nm: f64,
}

/// Invalid parameters of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum BadDrive {
    /// A number is not positive, or not finite.
    #[error("{0} must be above 0 and finite")]
    NotPositive(&'static str),
    /// Unsupported width of the converter.
    #[error("unsupported converter of {0} bits; use 8 to 24")]
    Bits(u32),
    /// The limit exceeds the converter's full scale.
    #[error("the torque limit exceeds the converter's full scale; lower the limit")]
    OutOfScale,
}

impl Drive {
    /// A drive whose converter of `bits` goes from minus to plus `full_scale_v`, with `torque_per_volt_nm` at the link,
    /// which is never given more than `limit_nm`.
    pub fn new(
        torque_per_volt_nm: f64,
        full_scale_v: f64,
        bits: u32,
        limit_nm: f64,
    ) -> Result<Self, BadDrive> {
        for (what, value) in [
            ("the torque per volt", torque_per_volt_nm),
            ("the full scale", full_scale_v),
            ("the limit of the torque", limit_nm),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(BadDrive::NotPositive(what));
            }
        }
        if !(8..=24).contains(&bits) {
            return Err(BadDrive::Bits(bits));
        }
        let drive = Self {
            torque_per_volt_nm,
            full_scale_v,
            bits,
            limit_nm,
        };
        if limit_nm > drive.torque(drive.code_max()) {
            return Err(BadDrive::OutOfScale);
        }
        Ok(drive)
    }

    /// The largest torque, N·m.
    pub fn limit_nm(&self) -> f64 {
        self.limit_nm
    }

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
