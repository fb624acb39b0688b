//! The text before the samples: one field a line, ended by an empty line.

use std::io::{BufRead, Read};
use std::path::Path;

use nalgebra::Matrix3;
use palpate_tissue::Vec3;

use crate::InputError;
use crate::labels::Affine;
use crate::labels::samples::SampleType;
use crate::labels::volume::{broken, checked_size, not_labels, not_one_volume, not_whole};

/// Largest header in bytes. Reason: with key/value pairs of a segmentation of hundreds of names it is some 100
/// kB. Beyond the bound the file is rejected.
const HEADER_BYTES_MAX: u64 = 1 << 22;

/// Most axes a file may name (the format's own limit).
const AXES_MAX: usize = 16;

/// Encoding of the samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Raw,
    Gzip,
    Ascii,
}

/// Fields of the header.
pub(super) struct Header<'a> {
    path: &'a Path,
    pub(super) sample: SampleType,
    pub(super) encoding: Encoding,
    pub(super) big_endian: bool,
    pub(super) line_skip: u64,
    /// `None`: the samples are the last bytes of the file.
    pub(super) byte_skip: Option<u64>,
    /// A detached header's data file, relative to the header.
    pub(super) data_file: Option<String>,
    sizes: Vec<u64>,
    /// Steps along each axis, `None` for an axis that is not spatial.
    directions: Option<Vec<Option<Vec3>>>,
    spacings: Option<Vec<f64>>,
    origin: Option<Vec3>,
    /// Factor that turns each world axis into RAS; `None` when the file does not define it.
    to_ras: Option<[f64; 3]>,
    unit_m: f64,
}

/// A header while it is read: the fields in file order.
struct Fields<'a> {
    path: &'a Path,
    fields: Vec<(usize, String, String)>,
}

impl<'a> Header<'a> {
    pub(super) fn read(path: &'a Path, from: &mut impl BufRead) -> Result<Self, InputError> {
        let fields = Fields::read(path, from)?;
        let dimension: usize = fields.number("dimension")?;
        if !(1..=AXES_MAX).contains(&dimension) {
            let what = format!("{dimension} axes; must be between 1 and {AXES_MAX}");
            return Err(fields.broken("dimension", what));
        }
        let sizes: Vec<u64> = fields.numbers("sizes", fields.needed("sizes")?)?;
        if sizes.len() != dimension {
            let what = format!("{} numbers for {dimension} axes", sizes.len());
            return Err(fields.broken("sizes", what));
        }
        let sample = sample_type(path, fields.needed("type")?)?;
        let encoding = match fields.needed("encoding")?.to_lowercase().as_str() {
            "raw" => Encoding::Raw,
            "gzip" | "gz" => Encoding::Gzip,
            "ascii" | "text" | "txt" => Encoding::Ascii,
            other => {
                let what = format!("\"{other}\" is not read; save the volume as raw or gzip");
                return Err(fields.broken("encoding", what));
            }
        };
        let big_endian = match fields.get("endian").map(str::to_lowercase).as_deref() {
            Some("big") => true,
            Some("little") => false,
            None if sample.bytes() == 1 || encoding == Encoding::Ascii => false,
            None => return Err(fields.missing("endian")),
            Some(other) => {
                let what = format!("\"{other}\" is neither big nor little");
                return Err(fields.broken("endian", what));
            }
        };
        let byte_skip = match fields.optional::<i64>("byte skip")?.unwrap_or(0) {
            -1 if encoding == Encoding::Raw => None,
            n if n >= 0 => Some(n as u64),
            n => return Err(fields.broken("byte skip", format!("{n} bytes"))),
        };
        let (to_ras, world_axes) = space(&fields)?;
        let directions = match fields.get("space directions") {
            Some(text) => Some(fields.directions(text, dimension)?),
            None => None,
        };
        if directions.is_some() && world_axes != 3 {
            let what = format!("{world_axes} axes; the world has three");
            return Err(fields.broken("space dimension", what));
        }
        let spacings = match fields.get("spacings") {
            Some(text) => Some(fields.numbers::<f64>("spacings", text)?),
            None => None,
        };
        if spacings.as_ref().is_some_and(|s| s.len() != dimension) {
            let what = format!("not {dimension} numbers, one per axis");
            return Err(fields.broken("spacings", what));
        }
        let origin = match fields.get("space origin") {
            Some(text) => Some(fields.vector("space origin", text)?),
            None => None,
        };
        Ok(Self {
            path,
            sample,
            encoding,
            big_endian,
            line_skip: fields.optional("line skip")?.unwrap_or(0),
            byte_skip,
            data_file: fields.data_file()?,
            sizes,
            directions,
            spacings,
            origin,
            to_ras,
            unit_m: unit(&fields)?,
        })
    }

    /// The three spatial axes of the file; all others must have one entry.
    fn axes(&self) -> Result<[usize; 3], InputError> {
        let mut spatial: Vec<usize> = (0..self.sizes.len()).collect();
        if let Some(directions) = &self.directions {
            spatial.retain(|a| directions[*a].is_some());
        }
        // Without directions, axes of one entry are dropped from the end.
        while self.directions.is_none() && spatial.len() > 3 {
            let last = spatial.iter().rposition(|a| self.sizes[*a] == 1);
            spatial.remove(last.unwrap_or(spatial.len() - 1));
        }
        let surplus = (0..self.sizes.len()).find(|a| !spatial.contains(a) && self.sizes[*a] != 1);
        if let Some(a) = surplus {
            return Err(not_one_volume(
                self.path,
                format!(
                    "{} axes, and axis {} with {} entries is none of space: these are several \
                     volumes, or several components per voxel",
                    self.sizes.len(),
                    a + 1,
                    self.sizes[a]
                ),
            ));
        }
        spatial.try_into().map_err(|s: Vec<usize>| {
            not_one_volume(self.path, format!("{} axes of space", s.len()))
        })
    }

    pub(super) fn size(&self) -> Result<[usize; 3], InputError> {
        checked_size(self.path, self.axes()?.map(|a| self.sizes[a]))
    }

    /// Orientation in m, RAS, and warnings about it.
    pub(super) fn to_world(&self) -> Result<(Affine, Vec<String>), InputError> {
        let axes = self.axes()?;
        let mut warnings = Vec::new();
        let in_space = match (&self.directions, &self.spacings) {
            (Some(directions), _) => {
                let step = |c: usize| directions[axes[c]].unwrap_or_default();
                Matrix3::from_columns(&[step(0), step(1), step(2)])
            }
            (None, Some(spacings)) => {
                Matrix3::from_diagonal(&Vec3::from(axes.map(|a| spacings[a])))
            }
            (None, None) => {
                warnings.push("the header has no voxel size: 1 mm is assumed on all axes".into());
                Matrix3::identity()
            }
        };
        if self.to_ras.is_none() {
            warnings.push(
                "the header has no orientation: the axis order of the file is assumed".into(),
            );
        }
        let sign = self.to_ras.unwrap_or([1.0; 3]);
        let affine = Affine {
            linear: Matrix3::from_fn(|r, c| in_space[(r, c)] * sign[r] * self.unit_m),
            origin: Vec3::from_fn(|r, _| {
                self.origin.unwrap_or_default()[r] * sign[r] * self.unit_m
            }),
        };
        let affine = affine.checked(self.path, "header (space directions, spacings)")?;
        Ok((affine, warnings))
    }
}

impl<'a> Fields<'a> {
    fn read(path: &'a Path, from: &mut impl BufRead) -> Result<Self, InputError> {
        let mut this = Self {
            path,
            fields: Vec::new(),
        };
        let mut from = from.take(HEADER_BYTES_MAX);
        let mut bytes = Vec::new();
        for number in 1.. {
            bytes.clear();
            let got = from.read_until(b'\n', &mut bytes);
            let got = got.map_err(InputError::io(path))?;
            let text = String::from_utf8_lossy(&bytes);
            let line = text.trim_end_matches(['\n', '\r']);
            if number == 1 {
                if !line.starts_with("NRRD000") {
                    return Err(not_labels(path, "this is not an NRRD file"));
                }
                continue;
            }
            // A detached header may end with the file.
            if got == 0 && from.limit() == 0 {
                let what = format!("it does not end within {HEADER_BYTES_MAX} bytes");
                return Err(this.broken("end", what));
            }
            if line.is_empty() {
                return Ok(this);
            }
            // Comments begin with #; key/value pairs are divided by := and do not affect the shape.
            if line.starts_with('#') || line.contains(":=") {
                continue;
            }
            let Some((key, value)) = line.split_once(':') else {
                let what = format!("\"{line:.40}\" is no field");
                return Err(this.broken(&format!("line {number}"), what));
            };
            let key = key.trim().to_lowercase();
            this.fields.push((number, key, value.trim().to_owned()));
        }
        Ok(this)
    }

    fn get(&self, key: &str) -> Option<&str> {
        let short = key.replace(' ', "");
        let found = self.fields.iter().find(|f| f.1 == key || f.1 == short);
        found.map(|f| f.2.as_str())
    }

    fn needed(&self, key: &str) -> Result<&str, InputError> {
        self.get(key).ok_or_else(|| self.missing(key))
    }

    fn missing(&self, key: &str) -> InputError {
        self.broken(key, "this field is missing".into())
    }

    fn broken(&self, key: &str, what: String) -> InputError {
        let line = self.fields.iter().find(|f| f.1 == key);
        let line = line.map_or(String::new(), |f| format!(" (line {})", f.0));
        broken(self.path, format!("NRRD header, {key}{line}"), what)
    }

    fn numbers<T: std::str::FromStr>(&self, key: &str, text: &str) -> Result<Vec<T>, InputError> {
        text.split_whitespace()
            .map(|w| {
                w.parse()
                    .map_err(|_| self.broken(key, format!("\"{w:.40}\" is not such a number")))
            })
            .collect()
    }

    fn number<T: std::str::FromStr>(&self, key: &str) -> Result<T, InputError> {
        let text = self.needed(key)?;
        let word = text.trim();
        word.parse()
            .map_err(|_| self.broken(key, format!("\"{word:.40}\" is not such a number")))
    }

    fn optional<T: std::str::FromStr>(&self, key: &str) -> Result<Option<T>, InputError> {
        self.get(key).map(|_| self.number(key)).transpose()
    }

    /// "(x,y,z)".
    fn vector(&self, key: &str, text: &str) -> Result<Vec3, InputError> {
        let inner = text
            .trim()
            .strip_prefix('(')
            .and_then(|t| t.strip_suffix(')'));
        let numbers: Option<Vec<f64>> =
            inner.and_then(|t| t.split(',').map(|n| n.trim().parse().ok()).collect());
        match numbers.as_deref() {
            Some([x, y, z]) => Ok(Vec3::new(*x, *y, *z)),
            _ => Err(self.broken(key, format!("\"{text:.40}\" is not (x,y,z)"))),
        }
    }

    /// One vector or "none" per axis.
    fn directions(&self, text: &str, axes: usize) -> Result<Vec<Option<Vec3>>, InputError> {
        let key = "space directions";
        let mut found = Vec::new();
        let mut rest = text.trim();
        while !rest.is_empty() {
            let (word, after) = if rest.starts_with('(') {
                let end = rest.find(')').map_or(rest.len(), |at| at + 1);
                rest.split_at(end)
            } else {
                rest.split_once(char::is_whitespace).unwrap_or((rest, ""))
            };
            found.push(if word == "none" {
                None
            } else {
                Some(self.vector(key, word)?)
            });
            rest = after.trim_start();
        }
        if found.len() == axes {
            Ok(found)
        } else {
            let what = format!("{} entries for {axes} axes", found.len());
            Err(self.broken(key, what))
        }
    }

    fn data_file(&self) -> Result<Option<String>, InputError> {
        let Some(name) = self.get("data file") else {
            return Ok(None);
        };
        if name.starts_with("LIST") || name.contains('%') {
            let what = "several data files are not read; save the volume in one file";
            return Err(self.broken("data file", what.into()));
        }
        Ok(Some(name.to_owned()))
    }
}

fn sample_type(path: &Path, name: &str) -> Result<SampleType, InputError> {
    use SampleType::{F32, F64, I8, I16, I32, I64, U8, U16, U32, U64};
    let sample = match name.to_lowercase().as_str() {
        "signed char" | "int8" | "int8_t" => I8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => U8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => I16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => U16,
        "int" | "signed int" | "int32" | "int32_t" => I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => U32,
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => I64,
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
            U64
        }
        "float" => F32,
        "double" => F64,
        other => {
            return Err(not_whole(path, format!("of type \"{other:.40}\"")));
        }
    };
    Ok(sample)
}

/// Factors that turn the file's world axes into RAS, and the number of axes.
fn space(fields: &Fields) -> Result<(Option<[f64; 3]>, usize), InputError> {
    let Some(name) = fields.get("space") else {
        let axes = fields.optional("space dimension")?.unwrap_or(3);
        return Ok((None, axes));
    };
    let signs = match name.to_lowercase().as_str() {
        "right-anterior-superior" | "ras" => Some([1.0, 1.0, 1.0]),
        "left-anterior-superior" | "las" => Some([-1.0, 1.0, 1.0]),
        "left-posterior-superior" | "lps" => Some([-1.0, -1.0, 1.0]),
        "scanner-xyz" | "3d-right-handed" | "3d-left-handed" => None,
        other => {
            let what = format!("\"{other:.40}\" is not one of RAS, LAS, LPS and scanner-xyz");
            return Err(fields.broken("space", what));
        }
    };
    Ok((signs, 3))
}

fn unit(fields: &Fields) -> Result<f64, InputError> {
    let Some(text) = fields.get("space units") else {
        return Ok(1e-3);
    };
    let first = text.split('"').nth(1).unwrap_or(text).trim().to_lowercase();
    match first.as_str() {
        "mm" | "millimeter" | "millimetre" | "" => Ok(1e-3),
        "cm" => Ok(1e-2),
        "m" | "meter" | "metre" => Ok(1.0),
        "um" | "\u{b5}m" | "\u{3bc}m" | "micrometer" | "micron" => Ok(1e-6),
        other => {
            let what = format!("\"{other:.40}\" is not one of mm, cm, m and um");
            Err(fields.broken("space units", what))
        }
    }
}
