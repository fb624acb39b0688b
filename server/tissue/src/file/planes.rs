//! Writing and reading the content of a file: little-endian numbers, and columns of numbers as byte
//! planes (all first bytes, then all second bytes, …), which deflate packs far better than rows.

/// Content being written.
#[derive(Default)]
pub(crate) struct Content(pub(crate) Vec<u8>);

impl Content {
    pub(crate) fn u8(&mut self, value: u8) {
        self.0.push(value);
    }

    pub(crate) fn u32(&mut self, value: u32) {
        self.0.extend(value.to_le_bytes());
    }

    pub(crate) fn u64(&mut self, value: u64) {
        self.0.extend(value.to_le_bytes());
    }

    pub(crate) fn f64(&mut self, value: f64) {
        self.u64(value.to_bits());
    }

    pub(crate) fn text(&mut self, value: &str) {
        self.u32(value.len() as u32);
        self.0.extend(value.as_bytes());
    }

    /// A column of 64-bit numbers.
    pub(crate) fn plane64(&mut self, values: &(impl Iterator<Item = u64> + Clone)) {
        for byte in 0..8 {
            self.0
                .extend(values.clone().map(|v| (v >> (8 * byte)) as u8));
        }
    }

    /// A column of 32-bit numbers, each as its wrapping difference from the one before.
    pub(crate) fn steps32(&mut self, values: impl Iterator<Item = u32>) {
        let mut before = 0;
        let steps: Vec<u32> = values
            .map(|v| {
                let step = v.wrapping_sub(before);
                before = v;
                step
            })
            .collect();
        for byte in 0..4 {
            self.0.extend(steps.iter().map(|v| (v >> (8 * byte)) as u8));
        }
    }
}

/// The content ended before what it declares, or a text is not one.
pub(crate) struct Short;

impl From<Short> for String {
    fn from(_: Short) -> Self {
        "ends before its declared content".into()
    }
}

/// Content being read.
pub(crate) struct Reader<'a>(pub(crate) &'a [u8]);

impl<'a> Reader<'a> {
    pub(crate) fn bytes(&mut self, count: usize) -> Result<&'a [u8], Short> {
        if count > self.0.len() {
            return Err(Short);
        }
        let (head, tail) = self.0.split_at(count);
        self.0 = tail;
        Ok(head)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, Short> {
        Ok(self.bytes(1)?[0])
    }

    pub(crate) fn u32(&mut self) -> Result<u32, Short> {
        let bytes = self.bytes(4)?;
        Ok(u32::from_le_bytes(std::array::from_fn(|i| bytes[i])))
    }

    pub(crate) fn u64(&mut self) -> Result<u64, Short> {
        let bytes = self.bytes(8)?;
        Ok(u64::from_le_bytes(std::array::from_fn(|i| bytes[i])))
    }

    pub(crate) fn f64(&mut self) -> Result<f64, Short> {
        Ok(f64::from_bits(self.u64()?))
    }

    pub(crate) fn point(&mut self) -> Result<[f64; 3], Short> {
        Ok([self.f64()?, self.f64()?, self.f64()?])
    }

    pub(crate) fn text(&mut self) -> Result<String, Short> {
        let count = self.u32()? as usize;
        let bytes = self.bytes(count)?;
        Ok(std::str::from_utf8(bytes).map_err(|_| Short)?.to_owned())
    }

    pub(crate) fn plane64(&mut self, count: usize) -> Result<Vec<u64>, Short> {
        let planes = self.bytes(count.checked_mul(8).ok_or(Short)?)?;
        Ok((0..count)
            .map(|i| u64::from_le_bytes(std::array::from_fn(|b| planes[b * count + i])))
            .collect())
    }

    pub(crate) fn steps32(&mut self, count: usize) -> Result<Vec<u32>, Short> {
        let planes = self.bytes(count.checked_mul(4).ok_or(Short)?)?;
        let mut before = 0u32;
        Ok((0..count)
            .map(|i| {
                let step = u32::from_le_bytes(std::array::from_fn(|b| planes[b * count + i]));
                before = before.wrapping_add(step);
                before
            })
            .collect())
    }
}
