//! Small mp4 files of H.264, made in the test: pictures of one macroblock type (I_PCM, samples as they are) and pictures that
//! repeat the one before, so that a 4K second takes a few megabytes and every pixel is known. Every box can be left out or bent.

/// One picture.
#[derive(Clone, Copy)]
pub enum Picture {
    /// Luma by column and row; chroma is grey.
    Luma(fn(u32, u32) -> u8),
    /// One luma everywhere.
    Flat(u8),
    /// As the one before.
    Again,
    /// A sample of no bytes.
    Nothing,
}

/// A video to be written.
pub struct Movie {
    /// Multiples of 16.
    pub size: [u32; 2],
    pub pictures: Vec<Picture>,
    /// Ticks that each picture is shown; the last one is repeated.
    pub durations: Vec<u32>,
    /// Ticks per second.
    pub timescale: u32,
    /// Degrees clockwise by which a player has to turn it.
    pub rotation: u32,
    /// `a b c d` of the track's matrix instead of a rotation.
    pub matrix: Option<[i32; 4]>,
    /// Segments: ticks, first tick of the media, rate as 16.16 fixed point.
    pub edits: Vec<(u32, i32, i32)>,
    /// More boxes of the sample description.
    pub shapes: Vec<u8>,
    /// From this picture on a second sample description holds, which is the first once more.
    pub second_entry: Option<usize>,
    /// `vide`; anything else is another kind of track.
    pub handler: [u8; 4],
}

impl Movie {
    /// `pictures` at `fps`, upright.
    pub fn new(size: [u32; 2], fps: u32, pictures: Vec<Picture>) -> Self {
        Self {
            size,
            pictures,
            durations: vec![1],
            timescale: fps,
            rotation: 0,
            matrix: None,
            edits: Vec::new(),
            shapes: Vec::new(),
            second_entry: None,
            handler: *b"vide",
        }
    }

    /// The file, with its index in front of the media.
    pub fn bytes(&self) -> Vec<u8> {
        let samples: Vec<Vec<u8>> = self.samples();
        let head = container(*b"ftyp", &[b"isom\0\0\x02\0isomiso2avc1mp41"]);
        let length = self.index(&samples, 0).len();
        let first = (head.len() + length + 8) as u32;
        let mut file = head;
        file.extend(self.index(&samples, first));
        let media: u32 = samples.iter().map(|sample| sample.len() as u32).sum();
        file.extend((media + 8).to_be_bytes());
        file.extend(b"mdat");
        for sample in samples {
            file.extend(sample);
        }
        file
    }

    fn samples(&self) -> Vec<Vec<u8>> {
        let mut frame_number = 0;
        let mut intra = 0;
        let mut samples = Vec::with_capacity(self.pictures.len());
        for picture in &self.pictures {
            let unit = match picture {
                Picture::Nothing => {
                    samples.push(Vec::new());
                    continue;
                }
                Picture::Again => {
                    frame_number += 1;
                    self.repeated(frame_number)
                }
                Picture::Flat(luma) => {
                    frame_number = 0;
                    intra += 1;
                    self.stored(intra, |_, _| *luma)
                }
                Picture::Luma(of) => {
                    frame_number = 0;
                    intra += 1;
                    self.stored(intra, of)
                }
            };
            let mut sample = (unit.len() as u32).to_be_bytes().to_vec();
            sample.extend(unit);
            samples.push(sample);
        }
        samples
    }

    /// An IDR picture of I_PCM macroblocks (ITU-T H.264, 7.3.5).
    fn stored(&self, intra: u32, luma: impl Fn(u32, u32) -> u8) -> Vec<u8> {
        let mut bits = Bits::default();
        bits.golomb(0); // first macroblock
        bits.golomb(7); // I slices only
        bits.golomb(0); // picture parameter set
        bits.put(0, 8); // frame number
        bits.golomb(intra % 2); // neighbouring IDR pictures differ
        bits.put(0, 2); // reference marking
        bits.golomb(0); // quantiser
        bits.golomb(1); // no deblocking
        for row in 0..self.size[1] / 16 {
            for column in 0..self.size[0] / 16 {
                bits.golomb(25); // I_PCM
                bits.align();
                for y in 0..16 {
                    for x in 0..16 {
                        bits.byte(luma(16 * column + x, 16 * row + y));
                    }
                }
                for _ in 0..128 {
                    bits.byte(128);
                }
            }
        }
        bits.unit(0x65)
    }

    /// A picture whose macroblocks are all skipped.
    fn repeated(&self, frame_number: u32) -> Vec<u8> {
        let mut bits = Bits::default();
        bits.golomb(0); // first macroblock
        bits.golomb(5); // P slices only
        bits.golomb(0); // picture parameter set
        bits.put(frame_number % 256, 8);
        bits.put(0, 3); // no override, no reordering, no marking
        bits.golomb(0); // quantiser
        bits.golomb(1); // no deblocking
        bits.golomb(self.size[0] / 16 * (self.size[1] / 16)); // skipped macroblocks
        bits.unit(0x41)
    }

    /// `avcC`: baseline profile, level 5.2, pictures in the order of decoding.
    fn configuration(&self) -> Vec<u8> {
        let mut sequence = Bits::default();
        for byte in [66, 0xc0, 52] {
            sequence.byte(byte);
        }
        sequence.golomb(0);
        sequence.golomb(4); // frame numbers of 8 bits
        sequence.golomb(2); // order of decoding is order of display
        sequence.golomb(1); // one reference
        sequence.put(0, 1);
        sequence.golomb(self.size[0] / 16 - 1);
        sequence.golomb(self.size[1] / 16 - 1);
        sequence.put(0b1100, 4); // frames, direct inference, no cropping, no more
        let sequence = sequence.unit(0x67);
        let mut picture = Bits::default();
        picture.golomb(0);
        picture.golomb(0);
        picture.put(0, 2); // CAVLC
        picture.golomb(0);
        picture.golomb(0);
        picture.golomb(0);
        picture.put(0, 3); // no weights
        picture.golomb(0);
        picture.golomb(0);
        picture.golomb(0);
        picture.put(0b100, 3); // deblocking is said per slice
        let picture = picture.unit(0x68);
        let mut bytes = vec![1, 66, 0xc0, 52, 0xff, 0xe1];
        bytes.extend((sequence.len() as u16).to_be_bytes());
        bytes.extend(sequence);
        bytes.push(1);
        bytes.extend((picture.len() as u16).to_be_bytes());
        bytes.extend(picture);
        bytes
    }

    fn index(&self, samples: &[Vec<u8>], first: u32) -> Vec<u8> {
        let [width, height] = self.size;
        let count = samples.len() as u32;
        let duration = |at: usize| self.durations[at.min(self.durations.len() - 1)];
        let total: u32 = (0..samples.len()).map(duration).sum();
        let mut entry = vec![0; 78];
        entry[7] = 1;
        entry[24..26].copy_from_slice(&(width as u16).to_be_bytes());
        entry[26..28].copy_from_slice(&(height as u16).to_be_bytes());
        entry[28..36].copy_from_slice(&[0, 0x48, 0, 0, 0, 0x48, 0, 0]);
        entry[41] = 1;
        entry[75] = 24;
        entry[76..78].copy_from_slice(&[0xff, 0xff]);
        let entry = container(
            *b"avc1",
            &[
                &entry,
                &container(*b"avcC", &[&self.configuration()]),
                &self.shapes,
            ],
        );
        let words =
            |values: &[u32]| -> Vec<u8> { values.iter().flat_map(|v| v.to_be_bytes()).collect() };
        let mut times = vec![0, count];
        let mut sizes = vec![0, 0, count];
        let mut starts = vec![0, 0];
        for (at, sample) in samples.iter().enumerate() {
            times.extend([1, duration(at)]);
            sizes.push(sample.len() as u32);
            if !matches!(self.pictures[at], Picture::Again | Picture::Nothing) {
                starts.push(at as u32 + 1);
                starts[1] += 1;
            }
        }
        // One chunk, or one for each description.
        let (mut chunks, mut offsets) = (vec![0, 1, 1, count.max(1), 1], vec![0, 1, first]);
        if let Some(second) = self.second_entry {
            let before: usize = samples[..second].iter().map(Vec::len).sum();
            let second = second as u32;
            chunks = vec![0, 2, 1, second, 1, 2, count - second, 2];
            offsets = vec![0, 2, first, first + before as u32];
        }
        let table = container(
            *b"stbl",
            &[
                &container(*b"stsd", &[&words(&[0, 2]), &entry, &entry]),
                &container(*b"stts", &[&words(&times)]),
                &container(*b"stss", &[&words(&starts)]),
                &container(*b"stsc", &[&words(&chunks)]),
                &container(*b"stsz", &[&words(&sizes)]),
                &container(*b"stco", &[&words(&offsets)]),
            ],
        );
        let location = container(
            *b"dref",
            &[&words(&[0, 1]), &container(*b"url ", &[&[0, 0, 0, 1]])],
        );
        let information = container(
            *b"minf",
            &[
                &container(*b"vmhd", &[&[0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0]]),
                &container(*b"dinf", &[&location]),
                &table,
            ],
        );
        let mut handler = words(&[0, 0]);
        handler.extend(self.handler);
        handler.extend([0; 13]);
        let media = container(
            *b"mdia",
            &[
                &container(*b"mdhd", &[&words(&[0, 0, 0, self.timescale, total, 0])]),
                &container(*b"hdlr", &[&handler]),
                &information,
            ],
        );
        let one = 0x0001_0000_i32;
        let matrix = match self.rotation {
            90 => [0, one, 0, -one, 0, 0, 0, 0, 0x4000_0000],
            180 => [-one, 0, 0, 0, -one, 0, 0, 0, 0x4000_0000],
            270 => [0, -one, 0, one, 0, 0, 0, 0, 0x4000_0000],
            _ => [one, 0, 0, 0, one, 0, 0, 0, 0x4000_0000],
        };
        let movie_matrix = words(&[one, 0, 0, 0, one, 0, 0, 0, 0x4000_0000].map(|v: i32| v as u32));
        let matrix = match self.matrix {
            Some([a, b, c, d]) => [a, b, 0, c, d, 0, 0, 0, 0x4000_0000],
            None => matrix,
        };
        let matrix = words(&matrix.map(|value: i32| value as u32));
        let track = container(
            *b"tkhd",
            &[
                &words(&[7, 0, 0, 1, 0, total, 0, 0, 0, 0]),
                &matrix,
                &words(&[width << 16, height << 16]),
            ],
        );
        let movie = container(
            *b"mvhd",
            &[
                &words(&[
                    0,
                    0,
                    0,
                    self.timescale,
                    total,
                    0x0001_0000,
                    0x0100_0000,
                    0,
                    0,
                ]),
                &movie_matrix,
                &words(&[0, 0, 0, 0, 0, 0, 2]),
            ],
        );
        let mut list = vec![0, self.edits.len() as u32];
        for &(duration, time, rate) in &self.edits {
            list.extend([duration, time as u32, rate as u32]);
        }
        let edits = container(*b"edts", &[&container(*b"elst", &[&words(&list)])]);
        let edits = if self.edits.is_empty() {
            Vec::new()
        } else {
            edits
        };
        container(
            *b"moov",
            &[&movie, &container(*b"trak", &[&track, &edits, &media])],
        )
    }
}

/// A box.
pub fn container(kind: [u8; 4], parts: &[&[u8]]) -> Vec<u8> {
    let size = 8 + parts.iter().map(|part| part.len()).sum::<usize>();
    let mut bytes = (size as u32).to_be_bytes().to_vec();
    bytes.extend(kind);
    for part in parts {
        bytes.extend(*part);
    }
    bytes
}

/// Bits, most significant first.
#[derive(Default)]
struct Bits {
    bytes: Vec<u8>,
    open: u32,
}

impl Bits {
    fn put(&mut self, value: u32, count: u32) {
        for at in (0..count).rev() {
            if self.open == 0 {
                self.bytes.push(0);
                self.open = 8;
            }
            self.open -= 1;
            let bit = (value >> at & 1) as u8;
            *self.bytes.last_mut().unwrap() |= bit << self.open;
        }
    }

    /// Exp-Golomb, unsigned.
    fn golomb(&mut self, value: u32) {
        let bits = 32 - (value + 1).leading_zeros();
        self.put(0, bits - 1);
        self.put(value + 1, bits);
    }

    fn align(&mut self) {
        self.open = 0;
    }

    fn byte(&mut self, byte: u8) {
        if self.open == 0 {
            self.bytes.push(byte);
        } else {
            self.put(u32::from(byte), 8);
        }
    }

    /// A network abstraction layer unit: closed, with a byte against false start codes.
    fn unit(mut self, header: u8) -> Vec<u8> {
        self.put(1, 1);
        let mut unit = vec![header];
        let mut zeros = 0;
        for byte in self.bytes {
            if zeros >= 2 && byte <= 3 {
                unit.push(3);
                zeros = 0;
            }
            zeros = if byte == 0 { zeros + 1 } else { 0 };
            unit.push(byte);
        }
        unit
    }
}
