/* SPDX-License-Identifier: MIT */
/* The board as the host sees it on USB. The names are those of every Pico, so that its port
 * is /dev/serial/by-id/usb-Raspberry_Pi_Pico_<board id>-if00 whichever port of the firmware it
 * runs. */
#include "bridge.h"
#include "pico/unique_id.h"
#include "tusb.h"

enum { INTERFACE_CONTROL, INTERFACE_DATA, INTERFACES };
enum { ENDPOINT_NOTIFY = 0x81, ENDPOINT_OUT = 0x02, ENDPOINT_IN = 0x82, PACKET = 64 };
enum { TEXT_LANGUAGE, TEXT_MAKER, TEXT_PRODUCT, TEXT_SERIAL };
enum { ENGLISH = 0x0409, POWER_MA = 250, TEXT_MAX = 2 * PICO_UNIQUE_BOARD_ID_SIZE_BYTES };

uint8_t const *tud_descriptor_device_cb(void)
{
    static const tusb_desc_device_t device = {
        .bLength = sizeof device,
        .bDescriptorType = TUSB_DESC_DEVICE,
        .bcdUSB = 0x0200,
        .bDeviceClass = TUSB_CLASS_MISC,
        .bDeviceSubClass = MISC_SUBCLASS_COMMON,
        .bDeviceProtocol = MISC_PROTOCOL_IAD,
        .bMaxPacketSize0 = CFG_TUD_ENDPOINT0_SIZE,
        .idVendor = 0x2E8A,  /* Raspberry Pi */
        .idProduct = 0x000A, /* serial port of a program made with the pico-sdk */
        .bcdDevice = BRIDGE_FIRMWARE,
        .iManufacturer = TEXT_MAKER,
        .iProduct = TEXT_PRODUCT,
        .iSerialNumber = TEXT_SERIAL,
        .bNumConfigurations = 1,
    };

    return (const uint8_t *)&device;
}

uint8_t const *tud_descriptor_configuration_cb(uint8_t index)
{
    static const uint8_t configuration[] = {
        TUD_CONFIG_DESCRIPTOR(1, INTERFACES, 0, TUD_CONFIG_DESC_LEN + TUD_CDC_DESC_LEN, 0,
                              POWER_MA),
        TUD_CDC_DESCRIPTOR(INTERFACE_CONTROL, 0, ENDPOINT_NOTIFY, 8, ENDPOINT_OUT, ENDPOINT_IN,
                           PACKET),
    };

    (void)index;
    return configuration;
}

uint16_t const *tud_descriptor_string_cb(uint8_t index, uint16_t language)
{
    static uint16_t descriptor[1 + TEXT_MAX];
    char serial[TEXT_MAX + 1];
    const char *text;
    uint8_t size;

    (void)language;
    pico_get_unique_board_id_string(serial, sizeof serial);
    switch (index) {
    case TEXT_LANGUAGE:
        descriptor[0] = TUSB_DESC_STRING << 8 | 4;
        descriptor[1] = ENGLISH;
        return descriptor;
    case TEXT_MAKER:
        text = "Raspberry Pi";
        break;
    case TEXT_PRODUCT:
        text = "Pico";
        break;
    case TEXT_SERIAL:
        text = serial;
        break;
    default:
        return NULL;
    }
    for (size = 0; size < TEXT_MAX && text[size] != '\0'; size++) {
        descriptor[1 + size] = (uint8_t)text[size];
    }
    descriptor[0] = (uint16_t)(TUSB_DESC_STRING << 8 | (2 * size + 2));
    return descriptor;
}
