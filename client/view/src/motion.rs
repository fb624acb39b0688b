//! Reads the motion of a page's tool.

use palpate_protocol::datagram::POSITION_MAX_M;
use palpate_protocol::{Pose, ServerTime, ToolSample};

/// Number of this message, see `WIRE.md`.
const KIND: u8 = 16;

const SAMPLE_BYTES: usize = 40;

/// Samples of one message.
const SAMPLES_MAX: usize = 32;

/// Greatest difference of a rotation's norm from 1: single precision and a rounded computation.
const NORM_ERROR_MAX: f64 = 1e-3;

/// The samples of a message, in order of time; `None` if it is not a sound motion message.
pub(crate) fn parse(bytes: &[u8]) -> Option<Vec<ToolSample>> {
    let [KIND, count, 0, 0, samples @ ..] = bytes else {
        return None;
    };
    let count = usize::from(*count);
    let is_whole = (1..=SAMPLES_MAX).contains(&count) && samples.len() == count * SAMPLE_BYTES;
    let samples: Option<Vec<ToolSample>> = samples.chunks_exact(SAMPLE_BYTES).map(sample).collect();
    samples.filter(|s| is_whole && s.is_sorted_by_key(|s| s.time))
}

fn sample(bytes: &[u8]) -> Option<ToolSample> {
    let (time, rest) = bytes.split_first_chunk::<8>()?;
    let time_us = f64::from_le_bytes(*time);
    let float = |i: usize| -> Option<f64> {
        let four = rest.get(4 * i..4 * i + 4)?.try_into().ok()?;
        Some(f64::from(f32::from_le_bytes(four)))
    };
    let position_m = [float(0)?, float(1)?, float(2)?];
    let turn = [float(3)?, float(4)?, float(5)?, float(6)?];
    let buttons = rest.get(28..32)?;
    let norm = turn.iter().map(|x| x * x).sum::<f64>().sqrt();
    let is_sound = time_us.is_finite()
        && time_us.abs() < i64::MAX as f64
        && position_m.iter().all(|x| x.abs() <= POSITION_MAX_M)
        && (norm - 1.0).abs() <= NORM_ERROR_MAX;
    is_sound.then(|| ToolSample {
        time: ServerTime::from_micros(time_us as i64),
        pose: Pose {
            position_m,
            orientation: turn.map(|x| x / norm),
        },
        buttons: buttons[0],
        force_n: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(times: &[f64], x: f32, norm: f32) -> Vec<u8> {
        let mut bytes = vec![KIND, times.len() as u8, 0, 0];
        for time in times {
            bytes.extend(time.to_le_bytes());
            for v in [x, 0.0, 0.1, 0.0, 0.0, 0.0, norm] {
                bytes.extend(v.to_le_bytes());
            }
            bytes.extend(1_u32.to_le_bytes());
        }
        bytes
    }

    #[test]
    fn sound_motion_is_read_and_nonsense_is_rejected() {
        let read = parse(&message(&[1e6, 2e6], 0.05, 1.0)).unwrap();
        assert_eq!(read[1].time, ServerTime::from_micros(2_000_000));
        assert_eq!(
            (read[0].pose.orientation, read[0].buttons),
            ([0.0, 0.0, 0.0, 1.0], 1)
        );
        assert!((read[0].pose.position_m[0] - 0.05).abs() < 1e-8);
        for bad in [
            message(&[], 0.0, 1.0),
            message(&[2e6, 1e6], 0.0, 1.0),
            message(&[f64::NAN], 0.0, 1.0),
            message(&[1.0], f32::NAN, 1.0),
            message(&[1.0], 1e9, 1.0),
            message(&[1.0], 0.0, 0.0),
            message(&[1.0; 33], 0.0, 1.0),
            message(&[1.0], 0.0, 1.0)[..20].to_vec(),
            vec![],
            vec![9; 44],
        ] {
            assert_eq!(parse(&bad), None, "{bad:?}");
        }
    }
}
