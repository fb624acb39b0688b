//! NIfTI-1 in one file (`.nii`), plain or gzip-compressed.
//!
//! Field offsets and the meaning of the orientation fields are those of `nifti1.h` (Cox and others,
//! 2004): `sform` before `qform` before bare voxel sizes.

use std::io::{BufReader, Read};
use std::path::Path;

use flate2::bufread::MultiGzDecoder;
use nalgebra::Matrix3;
use palpate_tissue::Vec3;

use super::samples::{Coding, Gather, SampleType, read_fully};
use super::volume::{
    bad_orientation, broken, checked_size, drain, not_labels, not_one_volume, not_whole, open,
    surplus, truncated,
};
use super::{Affine, LabelVolume};
use crate::InputError;

const HEADER_BYTES: usize = 348;
/// The same number in a header of the second version.
const HEADER_BYTES_2: i32 = 540;
/// Largest part of a file before its voxels. Reason: header extensions hold a protocol or an XML text of some
/// kilobytes. Beyond the bound the file is rejected.
const OFFSET_MAX: f32 = 16_777_216.0;
/// Relative difference between the voxel sizes of `sform` and `pixdim` above which a warning is given.
const SPACING_MISMATCH: f64 = 0.01;
/// How much longer than 1 a rotation's quaternion may be. Reason: its parts are f32.
const QUATERNION_SLACK: f64 = 1e-4;

/// Reads a file.
pub(super) fn read(path: &Path) -> Result<LabelVolume, InputError> {
    let (file, bytes) = open(path)?;
    let mut file = BufReader::new(file);
    let mut start = [0; 2];
    let got = read_fully(&mut file, &mut start).map_err(InputError::io(path))?;
    let mut all = start[..got].chain(file);
    // The content decides whether it is compressed; names are unreliable.
    if start == [0x1f, 0x8b] {
        read_stream(path, &mut MultiGzDecoder::new(BufReader::new(all)), None)
    } else {
        read_stream(path, &mut all, Some(bytes))
    }
}

/// Reads a plain stream; `bytes` is its length if known.
fn read_stream(
    path: &Path,
    from: &mut impl Read,
    bytes: Option<u64>,
) -> Result<LabelVolume, InputError> {
    let header = Header::read(path, from)?;
    let size = header.size()?;
    let coding = header.coding()?;
    let (to_world, mut warnings) = header.to_world()?;
    let skip = header.skip()?;
    let voxels: usize = size.iter().product();
    let promised = (HEADER_BYTES + skip + voxels * coding.sample.bytes()) as u64;
    let mut gather = Gather::new(path, size);
    if let Some(bytes) = bytes.filter(|b| *b < promised) {
        let data = bytes.saturating_sub((HEADER_BYTES + skip) as u64);
        return Err(truncated(
            path,
            voxels as u64,
            data / coding.sample.bytes() as u64,
        ));
    }
    if let Some(left) = bytes
        .and_then(|b| b.checked_sub(promised))
        .filter(|b| *b > 0)
    {
        warnings.push(surplus(path, left));
    }
    let skipped = std::io::copy(&mut from.take(skip as u64), &mut std::io::sink())
        .map_err(|e| gather.stream_error(e))?;
    if skipped < skip as u64 {
        return Err(gather.truncated());
    }
    gather.read(from, coding, voxels)?;
    drain(from).map_err(|e| gather.stream_error(e))?;
    Ok(LabelVolume {
        size,
        labels: gather.finish()?,
        to_world,
        warnings,
    })
}

/// The bytes of the header and their byte order.
struct Header<'a> {
    path: &'a Path,
    bytes: [u8; HEADER_BYTES],
    big_endian: bool,
}

impl<'a> Header<'a> {
    fn read(path: &'a Path, from: &mut impl Read) -> Result<Self, InputError> {
        let not = |what: String| not_labels(path, what);
        let mut bytes = [0; HEADER_BYTES];
        let got = read_fully(from, &mut bytes)
            .map_err(|e| not(format!("its first bytes can not be read ({e})")))?;
        if got < HEADER_BYTES {
            return Err(not(format!(
                "it ends after {got} bytes, within the NIfTI header"
            )));
        }
        let own = [bytes[0], bytes[1], bytes[2], bytes[3]];
        let big_endian = match (i32::from_le_bytes(own), i32::from_be_bytes(own)) {
            (n, _) if n == HEADER_BYTES as i32 => false,
            (_, n) if n == HEADER_BYTES as i32 => true,
            (HEADER_BYTES_2, _) | (_, HEADER_BYTES_2) => {
                return Err(not("this is NIfTI-2".into()));
            }
            _ => return Err(not("this is not a NIfTI file".into())),
        };
        match &bytes[344..348] {
            b"n+1\0" => {}
            b"ni1\0" => {
                return Err(not(
                    "this is one half of a pair of files (.hdr and .img)".into()
                ));
            }
            _ => {
                return Err(not(
                    "it lacks the mark \"n+1\" of a NIfTI file (is it Analyze 7.5?)".into(),
                ));
            }
        }
        Ok(Self {
            path,
            bytes,
            big_endian,
        })
    }

    fn four(&self, at: usize) -> [u8; 4] {
        let mut b: [u8; 4] = std::array::from_fn(|i| self.bytes[at + i]);
        if self.big_endian {
            b.reverse();
        }
        b
    }

    fn i16(&self, at: usize) -> i16 {
        let b = [self.bytes[at], self.bytes[at + 1]];
        if self.big_endian {
            i16::from_be_bytes(b)
        } else {
            i16::from_le_bytes(b)
        }
    }

    fn f32(&self, at: usize) -> f64 {
        f64::from(f32::from_le_bytes(self.four(at)))
    }

    fn broken(&self, place: &str, what: String) -> InputError {
        broken(self.path, format!("NIfTI header, {place}"), what)
    }

    fn size(&self) -> Result<[usize; 3], InputError> {
        let dim: [i16; 8] = std::array::from_fn(|i| self.i16(40 + 2 * i));
        if !(1..=7).contains(&dim[0]) {
            return Err(self.broken("dim[0]", format!("{} axes", dim[0])));
        }
        let axes = &dim[1..=dim[0] as usize];
        if let Some(a) = axes.iter().position(|n| *n < 1) {
            return Err(self.broken(&format!("dim[{}]", a + 1), format!("{} voxels", axes[a])));
        }
        if let Some(a) = (3..axes.len()).find(|&a| axes[a] > 1) {
            return Err(not_one_volume(
                self.path,
                format!(
                    "{} axes, and the {} has {} entries: this is a series of volumes",
                    dim[0],
                    ["fourth", "fifth", "sixth", "seventh"][a - 3],
                    axes[a]
                ),
            ));
        }
        let at = |a: usize| axes.get(a).map_or(1, |n| *n as u64);
        checked_size(self.path, [at(0), at(1), at(2)])
    }

    fn coding(&self) -> Result<Coding, InputError> {
        use SampleType::{F32, F64, I8, I16, I32, I64, U8, U16, U32, U64};
        let (code, bits) = (self.i16(70), self.i16(72));
        let sample = match code {
            2 => U8,
            4 => I16,
            8 => I32,
            16 => F32,
            64 => F64,
            256 => I8,
            512 => U16,
            768 => U32,
            1024 => I64,
            1280 => U64,
            other => {
                let what = match other {
                    0 => "of unknown type (datatype 0)".into(),
                    1 => "single bits (datatype 1)".into(),
                    32 | 1792 | 2048 => "complex numbers".into(),
                    128 | 2304 => "colours (RGB)".into(),
                    1536 => "128-bit floating point".into(),
                    n => format!("of a type NIfTI does not have (datatype {n})"),
                };
                return Err(not_whole(self.path, what));
            }
        };
        if bits as usize != 8 * sample.bytes() {
            let what = format!("{bits} bits for a type of {} bytes", sample.bytes());
            return Err(self.broken("bitpix", what));
        }
        let mut coding = Coding::plain(sample, self.big_endian);
        // A slope of zero means that there is none.
        let slope = self.f32(112);
        if slope != 0.0 {
            coding.slope = slope;
            coding.intercept = self.f32(116);
        }
        Ok(coding)
    }

    /// Bytes between the header and the voxels.
    fn skip(&self) -> Result<usize, InputError> {
        let offset = f32::from_le_bytes(self.four(108));
        // Some programs write 0 in a single file; the voxels then follow the extension flag.
        let offset = if offset == 0.0 { 352.0 } else { offset };
        if !(offset >= HEADER_BYTES as f32 && offset <= OFFSET_MAX) {
            let what = format!("voxels begin at byte {offset}");
            return Err(self.broken("vox_offset", what));
        }
        Ok(offset as usize - HEADER_BYTES)
    }

    /// Orientation, in m, and warnings about it.
    fn to_world(&self) -> Result<(Affine, Vec<String>), InputError> {
        let unit = match self.bytes[123] & 7 {
            1 => 1.0,
            3 => 1e-6,
            // 0 is unknown; all common programs write millimetres.
            _ => 1e-3,
        };
        let pixdim = [1, 2, 3].map(|a| self.f32(76 + 4 * a));
        let mut warnings = Vec::new();
        let (in_unit, from) = if self.i16(254) > 0 {
            let row = |r: usize| [0, 1, 2, 3].map(|c| self.f32(280 + 16 * r + 4 * c));
            let rows = [row(0), row(1), row(2)];
            let affine = Affine {
                linear: Matrix3::from_fn(|r, c| rows[r][c]),
                origin: Vec3::from_fn(|r, _| rows[r][3]),
            };
            let spacing = affine.spacing_m();
            let differs = |a: usize| (spacing[a] / pixdim[a].abs() - 1.0).abs() > SPACING_MISMATCH;
            if (0..3).any(differs) {
                warnings.push(format!(
                    "the voxel size is {:.3} x {:.3} x {:.3} by sform and {:.3} x {:.3} x {:.3} by \
                     pixdim; sform is used",
                    spacing[0], spacing[1], spacing[2], pixdim[0], pixdim[1], pixdim[2]
                ));
            }
            (affine, "sform")
        } else if self.i16(252) > 0 {
            (self.qform(pixdim)?, "qform")
        } else {
            warnings.push(
                "the header says nothing of the orientation: axes are taken as they come, the first \
                 voxel stands at the origin"
                    .into(),
            );
            let affine = Affine {
                linear: Matrix3::from_diagonal(&Vec3::from(pixdim)),
                origin: Vec3::zeros(),
            };
            (affine, "pixdim")
        };
        let affine = Affine {
            linear: in_unit.linear * unit,
            origin: in_unit.origin * unit,
        };
        let affine = affine.checked(self.path, &format!("header ({from})"))?;
        Ok((affine, warnings))
    }

    /// Rotation as a quaternion (a, b, c, d) with a from the others, the third axis mirrored when
    /// pixdim[0] is negative (method 2 of `nifti1.h`).
    fn qform(&self, pixdim: [f64; 3]) -> Result<Affine, InputError> {
        let fault = |what: String| bad_orientation(self.path, "header (qform)", what);
        if let Some(a) = pixdim.iter().position(|p| *p <= 0.0) {
            return Err(fault(format!("pixdim[{}] is {}", a + 1, pixdim[a])));
        }
        let [b, c, d] = [256, 260, 264].map(|at| self.f32(at));
        let rest = 1.0 - (b * b + c * c + d * d);
        if rest.is_nan() || rest < -QUATERNION_SLACK {
            let length = (1.0 - rest).sqrt();
            return Err(fault(format!(
                "its rotation is not normalised (quaternion parts of length {length:.4}, at most 1)"
            )));
        }
        let a = rest.max(0.0).sqrt();
        let qfac = if self.f32(76) < 0.0 { -1.0 } else { 1.0 };
        let rotation = Matrix3::new(
            a * a + b * b - c * c - d * d,
            2.0 * (b * c - a * d),
            2.0 * (b * d + a * c),
            2.0 * (b * c + a * d),
            a * a + c * c - b * b - d * d,
            2.0 * (c * d - a * b),
            2.0 * (b * d - a * c),
            2.0 * (c * d + a * b),
            a * a + d * d - b * b - c * c,
        );
        let scale = [pixdim[0], pixdim[1], pixdim[2] * qfac];
        Ok(Affine {
            linear: Matrix3::from_fn(|r, k| rotation[(r, k)] * scale[k]),
            origin: Vec3::from([268, 272, 276].map(|at| self.f32(at))),
        })
    }
}
