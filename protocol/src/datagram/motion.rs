//! Tool samples in a datagram.
//!
//! ```text
//! count u8, then per tool
//!   participant u16 | samples u8 (top bit: forces follow) | newest age i32 µs before `generated`
//!   per sample, NEWEST first
//!     step u16 µs before the one above (0 for the newest) | position 3 x u24 of 0.01 mm
//!     orientation u48 | buttons u8 | force 3 x i16 of 0.01 N, where forces follow
//! ```
//!
//! 18 B a sample, 24 B with its force: a batch of eight with its header is 176 B.

use super::bytes::{Reader, Writer};
use super::{TRACK_MAX_SAMPLES, TRACKS_MAX, quantise};
use crate::{ParticipantId, Pose, ProtocolError, ServerTime, Span, ToolSample, ToolTrack};

const FORCES_FOLLOW: u8 = 0x80;
const TRACK_BYTES: usize = 7;
const SAMPLE_BYTES: usize = 18;
const FORCE_BYTES: usize = 6;

/// How many bytes a track takes in a datagram.
pub fn track_bytes(track: &ToolTrack) -> usize {
    let forces = track.samples.iter().any(|s| s.force_n.is_some());
    TRACK_BYTES + track.samples.len() * (SAMPLE_BYTES + if forces { FORCE_BYTES } else { 0 })
}

fn refuse(what: &'static str, detail: String) -> ProtocolError {
    ProtocolError::OutOfRange { what, detail }
}

pub(super) fn write(
    w: &mut Writer,
    generated: ServerTime,
    tracks: &[ToolTrack],
) -> Result<(), ProtocolError> {
    if tracks.len() > TRACKS_MAX {
        return Err(refuse("the number of tools", tracks.len().to_string()));
    }
    w.u8(tracks.len() as u8);
    tracks
        .iter()
        .try_for_each(|track| write_track(w, generated, track))
}

fn write_track(
    w: &mut Writer,
    generated: ServerTime,
    track: &ToolTrack,
) -> Result<(), ProtocolError> {
    let count = track.samples.len();
    let Some(newest) = track.samples.last().filter(|_| count <= TRACK_MAX_SAMPLES) else {
        return Err(refuse("the number of samples", count.to_string()));
    };
    let forces = track.samples.iter().any(|s| s.force_n.is_some());
    w.u16(track.participant.0);
    w.u8(count as u8 | if forces { FORCES_FOLLOW } else { 0 });
    let age = (generated - newest.time).as_micros();
    w.i32(i32::try_from(age).map_err(|_| refuse("the age of a sample", format!("{age} µs")))?);
    let mut above = newest.time;
    for sample in track.samples.iter().rev() {
        let step = (above - sample.time).as_micros();
        let step = u16::try_from(step)
            .map_err(|_| refuse("the step between samples", format!("{step} µs")))?;
        above = sample.time;
        w.u16(step);
        for x in sample.pose.position_m {
            w.low::<3>(u64::from(quantise::position(x)?));
        }
        w.low::<6>(quantise::rotation(sample.pose.orientation)?);
        w.u8(sample.buttons);
        if forces {
            for f in sample.force_n.unwrap_or_default() {
                w.i16(quantise::saturating_i16(f, quantise::FORCE_STEP_N));
            }
        }
    }
    Ok(())
}

pub(super) fn read(
    r: &mut Reader<'_>,
    generated: ServerTime,
) -> Result<Vec<ToolTrack>, ProtocolError> {
    r.part("motion");
    let count = usize::from(r.u8()?);
    if count > TRACKS_MAX {
        return Err(refuse("the number of tools", count.to_string()));
    }
    r.expect_items(count, TRACK_BYTES + SAMPLE_BYTES)?;
    (0..count).map(|_| read_track(r, generated)).collect()
}

fn read_track(r: &mut Reader<'_>, generated: ServerTime) -> Result<ToolTrack, ProtocolError> {
    let participant = ParticipantId(r.u16()?);
    let count_and_flag = r.u8()?;
    let forces = count_and_flag & FORCES_FOLLOW != 0;
    let count = usize::from(count_and_flag & !FORCES_FOLLOW);
    if !(1..=TRACK_MAX_SAMPLES).contains(&count) {
        return Err(refuse("the number of samples", count.to_string()));
    }
    let mut time = generated - Span::from_micros(i64::from(r.i32()?));
    let mut samples = Vec::with_capacity(count);
    for _ in 0..count {
        time = time - Span::from_micros(i64::from(r.u16()?));
        let mut position_m = [0.0; 3];
        for x in &mut position_m {
            *x = quantise::position_back(r.low::<3>()? as u32)?;
        }
        let orientation = quantise::rotation_back(r.low::<6>()?);
        let buttons = r.u8()?;
        let force_n = if forces { Some(read_force(r)?) } else { None };
        samples.push(ToolSample {
            time,
            pose: Pose {
                position_m,
                orientation,
            },
            buttons,
            force_n,
        });
    }
    samples.reverse();
    Ok(ToolTrack {
        participant,
        samples,
    })
}

fn read_force(r: &mut Reader<'_>) -> Result<[f64; 3], ProtocolError> {
    let mut force = [0.0; 3];
    for f in &mut force {
        *f = f64::from(r.i16()?) * quantise::FORCE_STEP_N;
    }
    Ok(force)
}
