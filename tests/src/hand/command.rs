//! `palpate-lab hand`.

use std::fmt::Write as _;

use clap::Args;

use super::{Hand, HandParameters, Random};
use crate::cli::print_line;

/// Maximum rows of a table, three hours at 1 kHz: the limit of the reader.
const ROWS_MAX: f64 = 1.1e7;

pub(crate) const HELP: &str = "\
Examples:
  palpate-lab hand --seed 7 --seconds 20 > hand.csv
  palpate-lab run table-7-1 --motion hand.csv

The table has one row per sample: time_s,x_m,y_m,z_m,qw,qx,qy,qz; seconds, metres, a unit quaternion. The quaternion
is optional in your own tables. Times increase, by any step.";

/// Arguments of `hand`.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Seed of the hand
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Length, s
    #[arg(long, default_value_t = 10.0, value_name = "S")]
    seconds: f64,
    /// Samples per second
    #[arg(long, default_value_t = 1000.0, value_name = "HZ")]
    rate_hz: f64,
    /// Root mean square of its speed, mm/s
    #[arg(long, default_value_t = 87.0, value_name = "MM/S")]
    speed_mm_s: f64,
    /// Amplitude of its tremor, mm
    #[arg(long, default_value_t = 0.1, value_name = "MM")]
    tremor_mm: f64,
}

pub(crate) fn run(arguments: &Arguments) -> Result<bool, String> {
    print_line(table(arguments)?.trim_end())?;
    Ok(true)
}

fn between(name: &str, x: f64, (low, high): (f64, f64)) -> Result<f64, String> {
    if (low..=high).contains(&x) {
        return Ok(x);
    }
    Err(format!("--{name} {x} is not between {low} and {high}"))
}

fn table(arguments: &Arguments) -> Result<String, String> {
    let seconds = between("seconds", arguments.seconds, (0.01, 10_800.0))?;
    let rate_hz = between("rate-hz", arguments.rate_hz, (10.0, 10_000.0))?;
    let rows = seconds * rate_hz;
    if rows > ROWS_MAX {
        return Err(format!(
            "{rows:.0} rows are more than {ROWS_MAX}: write fewer seconds or samples"
        ));
    }
    let parameters = HandParameters {
        speed_rms_m_s: 1e-3 * between("speed-mm-s", arguments.speed_mm_s, (0.0, 5000.0))?,
        tremor_m: 1e-3 * between("tremor-mm", arguments.tremor_mm, (0.0, 100.0))?,
        ..HandParameters::default()
    };
    let hand = Random::new(parameters, arguments.seed);
    let mut table = String::from("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n");
    for k in 0..=rows.floor() as u32 {
        let t_s = f64::from(k) / rate_hz;
        let ([x, y, z], [i, j, l, w]) = {
            let pose = hand.at(t_s);
            (pose.position_m, pose.orientation)
        };
        // Resolution of 0.1 µm and 1 µrad: a hundredth of the wire quantisation.
        // Writing to a string cannot fail.
        let _ = writeln!(
            table,
            "{t_s:.6},{x:.7},{y:.7},{z:.7},{w:.6},{i:.6},{j:.6},{l:.6}"
        );
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    use palpate_device::backend::replay::Motion;

    use super::*;

    fn arguments() -> Arguments {
        Arguments {
            seed: 3,
            seconds: 2.0,
            rate_hz: 1000.0,
            speed_mm_s: 87.0,
            tremor_mm: 0.1,
        }
    }

    #[test]
    fn written_motion_reads_back_equal() {
        let read = Motion::from_table(&table(&arguments()).unwrap()).unwrap();
        let hand = Random::new(HandParameters::default(), 3);
        for k in 1..200 {
            let t_s = f64::from(k) * 0.009_871;
            let (a, b) = (Hand::at(&read, t_s), hand.at(t_s));
            for (a, b) in a.position_m.iter().zip(b.position_m) {
                assert!((a - b).abs() < 1e-6, "{t_s}: {a} {b}");
            }
            let dot: f64 = a
                .orientation
                .iter()
                .zip(b.orientation)
                .map(|(a, b)| a * b)
                .sum();
            assert!(dot.abs() > 1.0 - 1e-9, "{t_s}: {dot}");
        }
    }

    #[test]
    fn invalid_length_is_rejected() {
        for seconds in [f64::NAN, -1.0, 1e9] {
            let said = table(&Arguments {
                seconds,
                ..arguments()
            });
            assert!(said.unwrap_err().contains("--seconds"));
        }
    }
}
