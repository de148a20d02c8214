/* SPDX-License-Identifier: MIT */
/* TinyUSB: one serial port (CDC). */
#ifndef GRASPD_TUSB_CONFIG_H
#define GRASPD_TUSB_CONFIG_H

#define CFG_TUSB_RHPORT0_MODE OPT_MODE_DEVICE
#define CFG_TUD_ENDPOINT0_SIZE 64
#define CFG_TUD_CDC 1
#define CFG_TUD_CDC_EP_BUFSIZE 64 /* full speed */
#define CFG_TUD_CDC_RX_BUFSIZE 256
#define CFG_TUD_CDC_TX_BUFSIZE 512 /* beside the bridge's own queue of 2 kB */

#endif
