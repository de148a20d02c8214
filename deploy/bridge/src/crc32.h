/* SPDX-License-Identifier: MIT */
/* CRC-32 of zlib, Ethernet and PNG: polynomial 0x04C11DB7 reflected, init and xor-out 0xFFFFFFFF
 * (IEEE 802.3, 3.2.9). */
#ifndef GRASPD_CRC32_H
#define GRASPD_CRC32_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Checksum of the bytes that gave `crc` (0 for none) followed by `byte`. */
uint32_t crc32_byte(uint32_t crc, uint8_t byte);

#ifdef __cplusplus
}
#endif

#endif
